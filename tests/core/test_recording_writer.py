# SPDX-License-Identifier: GPL-3.0-or-later
"""Writing a recording: what is written is read back, and an interruption leaves a recording that resumes."""

import errno
import json
import math
import os
from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.errors import FDDAError, OutputError, RecordingError
from fdda_addon.core.recording.folder_check import check_recordable
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter, array_header

from .. import systems
from .limb import (
    INFLUENCING,
    JOINTS,
    make_rig,
    partitions_of,
    random_poses,
    random_residuals,
    record_limb,
    recording_info,
)

POSES = 12


def files(path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in path.iterdir()}


def test_what_is_written_is_read_back(recording):
    rig, read = make_rig(), read_recording(recording)
    assert np.array_equal(read.pose_matrices, random_poses(POSES))
    assert np.array_equal(read.residuals, random_residuals(POSES))
    assert isinstance(read.residuals, np.memmap) and not read.residuals.flags.writeable
    for name in ("rest_positions", "rest_matrices", "skin_joints", "skin_weights", "face_starts", "face_vertices"):
        assert np.array_equal(getattr(read.rig, name), getattr(rig, name))
        assert getattr(read.rig, name).dtype == getattr(rig, name).dtype
    assert read.rig.joints == JOINTS and read.rig.fingerprint == rig.fingerprint
    assert [(p.joint, p.influencing) for p in read.partitions] == list(INFLUENCING.items())
    assert (read.info.poses, read.info.complete) == (POSES, POSES)
    assert read.info.sampling == recording_info(POSES).sampling


def test_arrays_are_plain_npy_files(recording):
    residuals = np.load(recording / "residuals.npy", mmap_mode="r", allow_pickle=False)
    assert residuals.shape == (POSES, 40, 3) and residuals.dtype == np.float32
    assert sorted(files(recording)) == [
        "face_starts.npy",
        "face_vertices.npy",
        "pose_matrices.npy",
        "recording.json",
        "residuals.npy",
        "rest_matrices.npy",
        "rest_positions.npy",
        "skin_joints.npy",
        "skin_weights.npy",
    ]


@pytest.mark.parametrize("complete", [0, 5, 10])
def test_resuming_continues_bit_for_bit(recording, tmp_path, complete):
    path = tmp_path / "interrupted"
    record_limb(path, POSES, complete)
    assert read_index(path)["complete"] == complete
    with pytest.raises(RecordingError, match=rf"is incomplete: {complete} of 12 poses; finish it with record --resume"):
        read_recording(path)
    record_limb(path, POSES, resume=True)
    assert files(path) == files(recording)


def test_resuming_a_complete_recording_changes_nothing(recording):
    before = files(recording)
    record_limb(recording, POSES, resume=True)
    assert files(recording) == before


def test_resume_where_nothing_was_recorded_starts(tmp_path, recording):
    record_limb(tmp_path / "new", POSES, resume=True)
    assert files(tmp_path / "new") == files(recording)


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_error_between_batches_leaves_what_was_complete(tmp_path, recording, error):
    path, rig = tmp_path / "interrupted", make_rig()
    with (
        pytest.raises(error),
        RecordingWriter(path, rig, partitions_of(rig), recording_info(POSES)) as writer,
    ):
        writer.append(random_poses(POSES)[:5], random_residuals(POSES)[:5])
        raise error
    record_limb(path, POSES, resume=True)
    assert files(path) == files(recording)


def test_an_error_before_the_first_pose_leaves_nothing(tmp_path):
    path, rig = tmp_path / "new" / "deeper", make_rig()
    with pytest.raises(KeyboardInterrupt), RecordingWriter(path, rig, partitions_of(rig), recording_info(POSES)):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_an_error_before_the_first_pose_leaves_a_folder_that_was_there(tmp_path):
    rig = make_rig()
    with pytest.raises(RuntimeError), RecordingWriter(tmp_path, rig, partitions_of(rig), recording_info(POSES)):
        raise RuntimeError
    assert tmp_path.is_dir() and list(tmp_path.iterdir()) == []


def test_a_torn_write_is_never_read(tmp_path, recording):
    """What lies behind the complete poses may be anything: a batch was being written when the power went."""
    path = tmp_path / "torn"
    record_limb(path, POSES, 5)
    for name, shape in (("pose_matrices", (4, 4, 4)), ("residuals", (40, 3))):
        row = 4 * math.prod(shape)
        with open(path / f"{name}.npy", "r+b") as file:
            file.seek(len(array_header((POSES, *shape), np.float32)) + 5 * row)
            file.write(b"\xff" * 2 * row)
    record_limb(path, POSES, resume=True)
    assert files(path) == files(recording)


def test_poses_do_not_count_when_the_index_cannot_be_written(tmp_path, monkeypatch):
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    rig = make_rig()
    with (
        pytest.raises(OutputError, match="5 of 12 poses are complete, continue with --resume"),
        RecordingWriter(tmp_path / "r", rig, partitions_of(rig), recording_info(POSES)) as writer,
    ):
        writer.append(random_poses(POSES)[:5], random_residuals(POSES)[:5])
        monkeypatch.setattr(f"{RecordingWriter.__module__}.write_index", refuse)
        writer.append(random_poses(POSES)[5:], random_residuals(POSES)[5:])


def test_poses_that_did_not_settle_are_counted_from_the_first_of_the_recording(tmp_path):
    rig = make_rig()
    with RecordingWriter(tmp_path / "r", rig, partitions_of(rig), recording_info(POSES)) as writer:
        for start in (0, 6):
            batch = slice(start, start + 6)
            writer.append(random_poses(POSES)[batch], random_residuals(POSES)[batch], unsettled=(1, 4))
    assert read_index(tmp_path / "r")["unsettled"] == [1, 4, 7, 10]


@pytest.mark.parametrize("name", ["residuals.npy", "pose_matrices.npy"])
@pytest.mark.parametrize("damage", ["shorter", "missing", "other header"])
def test_resuming_does_not_make_up_poses_that_are_gone(tmp_path, name, damage):
    record_limb(tmp_path / "r", POSES, 10)
    path = tmp_path / "r" / name
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(data[: len(data) // 2] if damage == "shorter" else data.replace(b"<f4", b"<i4"))
    before = files(tmp_path / "r")
    with pytest.raises(RecordingError, match=rf"Cannot resume.*'{name}' does not hold the 10 poses"):
        record_limb(tmp_path / "r", POSES, resume=True)
    assert files(tmp_path / "r") == before


def test_a_mesh_without_faces(tmp_path):
    rig = replace(make_rig(), face_starts=np.zeros(0, np.int32), face_vertices=np.zeros(0, np.int32))
    with RecordingWriter(tmp_path / "r", rig, partitions_of(rig), recording_info(POSES)) as writer:
        writer.append(random_poses(POSES), random_residuals(POSES))
    assert not {"faces", "corners"} & set(read_index(tmp_path / "r"))
    assert not list((tmp_path / "r").glob("face*"))
    assert len(read_recording(tmp_path / "r").rig.face_vertices) == 0


def test_a_recording_is_not_overwritten(recording):
    before = files(recording)
    with pytest.raises(RecordingError, match="already; continue it with --resume, replace it with --overwrite, or cho"):
        record_limb(recording)
    assert files(recording) == before


@pytest.mark.parametrize("index", ["", '{\n "format": "fdda-recording",\n "ver', '{"poses"', "whole"])
def test_a_recording_is_replaced_where_that_is_asked_for(recording, index):
    """One whose index is torn, too: it can be neither resumed nor recorded into."""
    other, place = recording.with_name("other"), recording / "recording.json"
    record_limb(other, POSES - 2)
    (recording / "notes.txt").write_text("mine")
    place.write_text(place.read_text() if index == "whole" else index)
    check_recordable(recording, resume=False, overwrite=True)
    rig = make_rig()
    info = recording_info(POSES - 2)
    with RecordingWriter(recording, rig, partitions_of(rig), info, overwrite=True) as writer:
        writer.append(random_poses(POSES - 2), random_residuals(POSES - 2))
    assert files(recording) == {**files(other), "notes.txt": b"mine"}


def test_the_index_of_something_else_is_not_replaced(tmp_path):
    (tmp_path / "recording.json").write_text('{"songs": []}')
    with pytest.raises(OutputError, match=r"its 'recording\.json' is of something else; choose another folder"):
        check_recordable(tmp_path, resume=False, overwrite=True)
    assert files(tmp_path) == {"recording.json": b'{"songs": []}'}


def test_another_folder_is_not_recorded_into(tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match="it is not an empty folder"):
        record_limb(tmp_path)
    with pytest.raises(OutputError, match="it is not an empty folder"):
        record_limb(tmp_path / "letter.txt")
    # Windows says that the file exists.
    words = ".+" if systems.WINDOWS else "Not a directory"
    with pytest.raises(OutputError, match=rf"letter\.txt.below'.*: {words}; make room or choose another folder"):
        record_limb(tmp_path / "letter.txt" / "below")
    assert files(tmp_path) == {"letter.txt": b"dear"}


def change(index, *keys, value):
    for key in keys[:-1]:
        index = index[key]
    index[keys[-1]] = value


@pytest.mark.parametrize(
    ("keys", "value", "named"),
    [
        (("sampling", "seed"), 3, "sampling.seed"),
        (("sampling", "spread"), 0.5, "sampling.spread"),
        (("sampling", "limits", 0, "high"), 0.1, "sampling.limits"),
        (("sampling", "sources", 1, "name"), "fist", "sampling.sources"),
        (("rig", "file"), "other.blend", "rig.file"),
        (("rig", "fingerprint", "skin_weights"), "0", "rig.fingerprint.skin_weights"),
        (("joints", 1, "name"), "arm", "joints"),
        (("partitions", 0, "influencing"), [2], "partitions"),
        (("poses",), 13, "poses"),
        (("blender",), "4.5.0", "blender"),
        (("extra",), 1, "extra"),
        (("faces",), 3, "faces"),
        (("corners",), 60, "corners"),
    ],
)
def test_resuming_something_else_names_what_differs(tmp_path, keys, value, named):
    record_limb(tmp_path / "r", POSES, 5)
    index = tmp_path / "r" / "recording.json"
    content = json.loads(index.read_text())
    change(content, *keys, value=value)
    index.write_text(json.dumps(content))
    before = files(tmp_path / "r")
    with pytest.raises(RecordingError, match=rf"it was recorded differently \({named}\); record with the same rig"):
        record_limb(tmp_path / "r", POSES, resume=True)
    assert files(tmp_path / "r") == before


@pytest.mark.parametrize("name", ["pose_matrices", "residuals"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_no_numbers_are_refused_and_the_pose_named(tmp_path, name, value):
    rig, arrays = make_rig(), {"pose_matrices": random_poses(POSES), "residuals": random_residuals(POSES)}
    arrays[name][7, 1, 2] = value
    with RecordingWriter(tmp_path / "r", rig, partitions_of(rig), recording_info(POSES)) as writer:
        writer.append(*(array[:5] for array in arrays.values()))
        with pytest.raises(FDDAError, match=rf"Pose 7 of the rig .* not numbers \({name}\)"):
            writer.append(*(array[5:10] for array in arrays.values()))
    assert read_index(tmp_path / "r")["complete"] == 5
