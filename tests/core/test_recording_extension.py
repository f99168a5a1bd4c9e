# SPDX-License-Identifier: GPL-3.0-or-later
"""A recording that grows: complete at every moment, whatever interrupts it."""

import json

import numpy as np
import pytest

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.recording.extension import RecordingExtension
from fdda_addon.core.recording.index import INDEX_NAME, REFINED, Source
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from .limb import make_rig, partitions_of, random_poses, random_residuals, recording_info

POSES, MORE = 12, 5


def extend(path, count: int = MORE, seed: int = 7) -> None:
    with RecordingExtension(read_recording(path), "limb.onnx") as extension:
        extension.append(random_poses(count, seed), random_residuals(count, seed))


def assert_holds(path, *parts: tuple[int, int]) -> None:
    """The recording is the first poses, and then (count, seed) more for each part."""
    read = read_recording(path)
    matrices = [random_poses(POSES), *(random_poses(count, seed) for count, seed in parts)]
    residuals = [random_residuals(POSES), *(random_residuals(count, seed) for count, seed in parts)]
    assert np.array_equal(read.pose_matrices, np.concatenate(matrices))
    assert np.array_equal(read.residuals, np.concatenate(residuals))


def test_poses_are_added_and_counted(recording):
    extend(recording)
    assert_holds(recording, (MORE, 7))
    assert read_recording(recording).info.sampling.sources[2:] == (Source(REFINED, MORE, "limb.onnx"),)
    with RecordingExtension(read_recording(recording), "again.onnx") as extension:
        for seed in (8, 9):
            extension.append(random_poses(2, seed), random_residuals(2, seed))
            assert extension.complete == POSES + MORE + 2 * (seed - 7)
    assert_holds(recording, (MORE, 7), (2, 8), (2, 9))
    assert [s.poses for s in read_recording(recording).info.sampling.sources] == [POSES - 2, 2, MORE, 4]


def test_arrays_stay_plain_npy_files(recording):
    extend(recording, 1000)
    for name in ("pose_matrices", "residuals"):
        assert len(np.load(recording / f"{name}.npy", mmap_mode="r", allow_pickle=False)) == POSES + 1000
        assert (recording / f"{name}.npy").stat().st_size % 4 == 0


def test_what_the_index_does_not_count_is_not_read_and_is_written_over(recording):
    before = (recording / INDEX_NAME).read_bytes()
    extend(recording)
    # As if the machine had stopped between the arrays and the index.
    (recording / INDEX_NAME).write_bytes(before)
    assert_holds(recording)
    extend(recording, 3, seed=8)
    assert_holds(recording, (3, 8))


def test_arrays_that_grew_without_a_header_are_read(recording):
    with open(recording / "residuals.npy", "ab") as file:
        file.write(b"torn")
    assert_holds(recording)
    extend(recording)
    assert_holds(recording, (MORE, 7))


def test_a_header_that_promises_too_much_is_refused(recording):
    extend(recording)
    index = json.loads((recording / INDEX_NAME).read_text())
    index["poses"] = index["complete"] = POSES
    index["sampling"]["sources"].pop()
    (recording / INDEX_NAME).write_text(json.dumps(index))
    with open(recording / "residuals.npy", "r+b") as file:
        file.truncate((recording / "residuals.npy").stat().st_size - 4)
    with pytest.raises(RecordingError, match="truncated"):
        read_recording(recording)


def test_sources_must_add_up(recording):
    index = json.loads((recording / INDEX_NAME).read_text())
    index["sampling"]["sources"][0]["poses"] -= 1
    (recording / INDEX_NAME).write_text(json.dumps(index))
    with pytest.raises(RecordingError, match=f"its sources do not add up to its {POSES} poses"):
        read_recording(recording)


def test_values_that_are_not_numbers_add_nothing(recording):
    residuals = random_residuals(MORE)
    residuals[3, 0, 0] = np.nan
    with (
        pytest.raises(RecordingError, match=rf"Pose {POSES + 3} of the rig .* not numbers \(residuals\)"),
        RecordingExtension(read_recording(recording), "limb.onnx") as extension,
    ):
        extension.append(random_poses(MORE), residuals)
    assert_holds(recording)


def test_one_process_extends_at_a_time(recording):
    with (
        RecordingExtension(read_recording(recording), "limb.onnx"),
        pytest.raises(RecordingError, match="This Blender is recording into"),
    ):
        RecordingExtension(read_recording(recording), "limb.onnx")
    extend(recording)
    assert_holds(recording, (MORE, 7))


def test_poses_that_another_process_added_meanwhile_are_not_written_over(recording):
    before = read_recording(recording)
    extend(recording)
    with pytest.raises(RecordingError, match=f"had {POSES} poses when it was read and has {POSES + MORE} now"):
        RecordingExtension(before, "limb.onnx")
    assert_holds(recording, (MORE, 7))
    extend(recording, 2, seed=8)
    assert_holds(recording, (MORE, 7), (2, 8))


def test_a_grown_recording_is_not_resumed_as_another(recording):
    extend(recording)
    with pytest.raises(RecordingError, match=r"recorded differently \(poses, sampling\.sources\)"):
        RecordingWriter(recording, make_rig(), partitions_of(make_rig()), recording_info(POSES), resume=True)
