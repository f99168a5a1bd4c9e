# SPDX-License-Identifier: GPL-3.0-or-later
"""Writing, resuming and extending a recording: it is read back unchanged, and interruptions lose nothing complete."""

import errno
import json
import math
import os
from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.errors import FDDAError, OutputError, RecordingError
from fdda_addon.core.recording.arrays import array_header
from fdda_addon.core.recording.folder import check_recordable
from fdda_addon.core.recording.index import INDEX_NAME, REFINED, Source, read_index
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingExtension, RecordingWriter

from .. import systems
from .limb import JOINTS, make_rig, random_poses, random_positions, record_limb, recording_info

POSE_COUNT = 12


def file_bytes(path) -> dict[str, bytes]:
    """Return the bytes of each file of the folder by its name."""
    return {file.name: file.read_bytes() for file in path.iterdir()}


def test_content_is_read_back_unchanged(recording):
    rig, read_back = make_rig(), read_recording(recording)
    assert np.array_equal(read_back.pose_matrices, random_poses(POSE_COUNT))
    assert np.array_equal(read_back.positions, random_positions(POSE_COUNT))
    assert isinstance(read_back.positions, np.memmap) and not read_back.positions.flags.writeable
    for name in ("rest_positions", "rest_matrices", "skin_joints", "skin_weights", "face_starts", "face_vertices"):
        assert np.array_equal(getattr(read_back.rig, name), getattr(rig, name))
        assert getattr(read_back.rig, name).dtype == getattr(rig, name).dtype
    assert read_back.rig.joints == JOINTS and read_back.rig.meshes[0].fingerprint == rig.meshes[0].fingerprint
    assert (read_back.info.poses, read_back.info.complete) == (POSE_COUNT, POSE_COUNT)
    assert read_back.info.sampling == recording_info(POSE_COUNT).sampling


@pytest.mark.parametrize("complete", [0, 10])
def test_a_resumed_recording_has_the_same_bytes(recording, tmp_path, complete):
    path = tmp_path / "interrupted"
    record_limb(path, POSE_COUNT, complete)
    assert read_index(path)["complete"] == complete
    with pytest.raises(RecordingError, match=rf"is incomplete: {complete} of 12 poses; finish it with record --resume"):
        read_recording(path)
    record_limb(path, POSE_COUNT, resume=True)
    assert file_bytes(path) == file_bytes(recording)


def test_an_error_between_batches_keeps_complete_poses(tmp_path, recording):
    path, rig = tmp_path / "interrupted", make_rig()
    with (
        pytest.raises(KeyboardInterrupt),
        RecordingWriter(path, rig, recording_info(POSE_COUNT)) as writer,
    ):
        writer.append(random_poses(POSE_COUNT)[:5], random_positions(POSE_COUNT)[:5])
        raise KeyboardInterrupt
    record_limb(path, POSE_COUNT, resume=True)
    assert file_bytes(path) == file_bytes(recording)


def test_an_error_before_the_first_pose_leaves_no_folder(tmp_path):
    path, rig = tmp_path / "new" / "deeper", make_rig()
    with pytest.raises(KeyboardInterrupt), RecordingWriter(path, rig, recording_info(POSE_COUNT)):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_an_incompletely_written_batch_is_not_read(tmp_path, recording):
    """After a power failure, the arrays may contain any bytes beyond the complete poses."""
    path = tmp_path / "torn"
    record_limb(path, POSE_COUNT, 5)
    for name, shape in (("pose_matrices", (4, 4, 4)), ("positions", (40, 3))):
        pose_bytes = 4 * math.prod(shape)
        with open(path / f"{name}.npy", "r+b") as file:
            file.seek(len(array_header((POSE_COUNT, *shape), np.float32)) + 5 * pose_bytes)
            file.write(b"\xff" * 2 * pose_bytes)
    record_limb(path, POSE_COUNT, resume=True)
    assert file_bytes(path) == file_bytes(recording)


def test_poses_are_incomplete_if_the_index_cannot_be_written(tmp_path, monkeypatch):
    def fail_to_write(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    rig = make_rig()
    with (
        pytest.raises(OutputError, match="5 of 12 poses are complete; make room and run the command again"),
        RecordingWriter(tmp_path / "r", rig, recording_info(POSE_COUNT)) as writer,
    ):
        writer.append(random_poses(POSE_COUNT)[:5], random_positions(POSE_COUNT)[:5])
        monkeypatch.setattr(f"{RecordingWriter.__module__}.write_json", fail_to_write)
        writer.append(random_poses(POSE_COUNT)[5:], random_positions(POSE_COUNT)[5:])


def test_unsettled_poses_are_indexed_within_the_recording(tmp_path):
    rig = make_rig()
    with RecordingWriter(tmp_path / "r", rig, recording_info(POSE_COUNT)) as writer:
        for start in (0, 6):
            batch = slice(start, start + 6)
            writer.append(random_poses(POSE_COUNT)[batch], random_positions(POSE_COUNT)[batch], unsettled=(1, 4))
    assert read_index(tmp_path / "r")["unsettled"] == [1, 4, 7, 10]


@pytest.mark.parametrize("name", ["positions.npy", "pose_matrices.npy"])
@pytest.mark.parametrize("damage", ["shorter", "missing", "other header"])
def test_resuming_without_the_complete_poses_is_refused(tmp_path, name, damage):
    record_limb(tmp_path / "r", POSE_COUNT, 10)
    path = tmp_path / "r" / name
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(data[: len(data) // 2] if damage == "shorter" else data.replace(b"<f4", b"<i4"))
    bytes_before = file_bytes(tmp_path / "r")
    with pytest.raises(RecordingError, match=rf"{name}' cannot be used: .*; record again"):
        record_limb(tmp_path / "r", POSE_COUNT, resume=True)
    assert file_bytes(tmp_path / "r") == bytes_before


def test_a_mesh_without_faces_is_recorded_and_read(tmp_path):
    rig = replace(make_rig(), face_starts=np.zeros(0, np.int32), face_vertices=np.zeros(0, np.int32))
    with RecordingWriter(tmp_path / "r", rig, recording_info(POSE_COUNT)) as writer:
        writer.append(random_poses(POSE_COUNT), random_positions(POSE_COUNT))
    assert not {"faces", "corners"} & set(read_index(tmp_path / "r"))
    assert not list((tmp_path / "r").glob("face*"))
    assert len(read_recording(tmp_path / "r").rig.face_vertices) == 0


def test_a_recording_is_not_overwritten(recording):
    bytes_before = file_bytes(recording)
    with pytest.raises(RecordingError, match="already; continue it with --resume, replace it with --overwrite, or cho"):
        record_limb(recording)
    assert file_bytes(recording) == bytes_before


@pytest.mark.parametrize("index_text", ["", '{\n "format": "fdda-recording",\n "ver', '{"poses"', "whole"])
def test_a_recording_is_replaced_on_request(recording, index_text):
    """A recording with an incomplete index is replaced too, although it cannot be resumed."""
    expected_recording, index_path = recording.with_name("other"), recording / "recording.json"
    record_limb(expected_recording, POSE_COUNT - 2)
    (recording / "notes.txt").write_text("mine")
    index_path.write_text(index_path.read_text() if index_text == "whole" else index_text)
    check_recordable(recording, resume=False, overwrite=True)
    rig = make_rig()
    info = recording_info(POSE_COUNT - 2)
    with RecordingWriter(recording, rig, info, overwrite=True) as writer:
        writer.append(random_poses(POSE_COUNT - 2), random_positions(POSE_COUNT - 2))
    assert file_bytes(recording) == {**file_bytes(expected_recording), "notes.txt": b"mine"}


def test_the_index_of_something_else_is_not_replaced(tmp_path):
    (tmp_path / "recording.json").write_text('{"songs": []}')
    with pytest.raises(OutputError, match=r"its 'recording\.json' is of something else; choose another folder"):
        check_recordable(tmp_path, resume=False, overwrite=True)
    assert file_bytes(tmp_path) == {"recording.json": b'{"songs": []}'}


def test_a_folder_with_other_files_is_refused(tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match="it is not an empty folder"):
        record_limb(tmp_path)
    with pytest.raises(OutputError, match="it is not an empty folder"):
        record_limb(tmp_path / "letter.txt")
    # Windows reports another error: that the file exists.
    words = ".+" if systems.WINDOWS else "Not a directory"
    with pytest.raises(OutputError, match=rf"letter\.txt.below'.*: {words}; make room or choose another folder"):
        record_limb(tmp_path / "letter.txt" / "below")
    assert file_bytes(tmp_path) == {"letter.txt": b"dear"}


def set_nested_value(index, *keys, value):
    """Set a value in nested dictionaries and lists of the index."""
    for key in keys[:-1]:
        index = index[key]
    index[keys[-1]] = value


@pytest.mark.parametrize(
    ("keys", "value", "difference"),
    [
        (("sampling", "seed"), 3, "sampling.seed"),
        (("sampling", "limits", 0, "high"), 0.1, "sampling.limits"),
        (("meshes", 0, "fingerprint", "skin_weights"), "0", "meshes"),
        (("joints", 1, "name"), "arm", "joints"),
        (("bones", "dependencies"), [2], "bones.dependencies"),
        (("poses",), 13, "poses"),
        (("extra",), 1, "extra"),
        (("corners",), 60, "corners"),
    ],
)
def test_resuming_another_recording_names_the_differences(tmp_path, keys, value, difference):
    record_limb(tmp_path / "r", POSE_COUNT, 5)
    index_path = tmp_path / "r" / ("bones.json" if keys[0] == "bones" else "recording.json")
    content = json.loads(index_path.read_text())
    set_nested_value(content, *keys[keys[0] == "bones" :], value=value)
    index_path.write_text(json.dumps(content))
    bytes_before = file_bytes(tmp_path / "r")
    with pytest.raises(
        RecordingError, match=rf"it was recorded differently \({difference}\); record with the same rig"
    ):
        record_limb(tmp_path / "r", POSE_COUNT, resume=True)
    assert file_bytes(tmp_path / "r") == bytes_before


@pytest.mark.parametrize(("name", "value"), [("pose_matrices", np.nan), ("positions", np.inf)])
def test_non_finite_values_are_refused_with_the_pose(tmp_path, name, value):
    rig, arrays = make_rig(), {"pose_matrices": random_poses(POSE_COUNT), "positions": random_positions(POSE_COUNT)}
    arrays[name][7, 1, 2] = value
    with RecordingWriter(tmp_path / "r", rig, recording_info(POSE_COUNT)) as writer:
        writer.append(*(array[:5] for array in arrays.values()))
        with pytest.raises(FDDAError, match=rf"Pose 7 of the rig .* not numbers \({name}\)"):
            writer.append(*(array[5:10] for array in arrays.values()))
    assert read_index(tmp_path / "r")["complete"] == 5


ADDED_COUNT = 5


def append_poses(path, count: int = ADDED_COUNT, seed: int = 7) -> None:
    """Append random poses to the recording as those of a refinement."""
    with RecordingExtension(read_recording(path), count, "limb.onnx") as extension:
        extension.append(random_poses(count, seed), random_positions(count, seed))


def assert_poses(path, *parts: tuple[int, int]) -> None:
    """Check that the recording has its first poses, then those that `append_poses` adds for each (count, seed)."""
    recording = read_recording(path)
    matrices = [random_poses(POSE_COUNT), *(random_poses(count, seed) for count, seed in parts)]
    positions = [random_positions(POSE_COUNT), *(random_positions(count, seed) for count, seed in parts)]
    assert np.array_equal(recording.pose_matrices, np.concatenate(matrices))
    assert np.array_equal(recording.positions, np.concatenate(positions))


def test_poses_are_appended_and_counted(recording):
    append_poses(recording)
    assert_poses(recording, (ADDED_COUNT, 7))
    assert read_recording(recording).info.sampling.sources[2:] == (Source(REFINED, ADDED_COUNT, "limb.onnx"),)
    with RecordingExtension(read_recording(recording), 4, "again.onnx") as extension:
        for seed in (8, 9):
            extension.append(random_poses(2, seed), random_positions(2, seed))
            assert extension.complete == POSE_COUNT + ADDED_COUNT + 2 * (seed - 7)
    assert_poses(recording, (ADDED_COUNT, 7), (2, 8), (2, 9))
    assert [s.poses for s in read_recording(recording).info.sampling.sources] == [POSE_COUNT - 2, 2, ADDED_COUNT, 4]


def test_poses_beyond_the_index_are_ignored_and_overwritten(recording):
    index_before = (recording / INDEX_NAME).read_bytes()
    append_poses(recording)
    # This is the state after the machine stopped between writing the arrays and writing the index.
    (recording / INDEX_NAME).write_bytes(index_before)
    assert_poses(recording)
    append_poses(recording, 3, seed=8)
    assert_poses(recording, (3, 8))


def test_poses_that_another_process_appended_are_not_overwritten(recording):
    recording_before = read_recording(recording)
    append_poses(recording)
    with pytest.raises(
        RecordingError, match=f"had {POSE_COUNT} poses when it was read and has {POSE_COUNT + ADDED_COUNT} now"
    ):
        RecordingExtension(recording_before, ADDED_COUNT, "limb.onnx")
    assert_poses(recording, (ADDED_COUNT, 7))
    append_poses(recording, 2, seed=8)
    assert_poses(recording, (ADDED_COUNT, 7), (2, 8))


def test_resuming_an_extended_recording_is_refused(recording):
    append_poses(recording)
    with pytest.raises(RecordingError, match=r"recorded differently \(poses, sampling\.sources\)"):
        RecordingWriter(recording, make_rig(), recording_info(POSE_COUNT), resume=True)


def record_in_unit(path, metres_per_unit: float, complete: int = 6, resume: bool = False):
    """Record the first `complete` of six poses of the limb in a unit, and return the folder."""
    rig = replace(make_rig(), metres_per_unit=metres_per_unit)
    with RecordingWriter(path, rig, recording_info(6), resume) as writer:
        pose_slice = slice(writer.complete, complete)
        writer.append(random_poses(6)[pose_slice], random_positions(6)[pose_slice])
    return path


@pytest.mark.parametrize(("first_unit", "resumed_unit"), [(0.01, 1.0), (1.0, 0.01), (0.01, 0.02)])
def test_a_resumed_recording_keeps_its_unit(tmp_path, first_unit, resumed_unit):
    """The unit may differ when a recording is resumed, because the scale of an object may be animated."""
    record_in_unit(tmp_path / "recording", first_unit, complete=3)
    record_in_unit(tmp_path / "recording", resumed_unit, resume=True)
    assert read_recording(tmp_path / "recording").rig.metres_per_unit == first_unit
