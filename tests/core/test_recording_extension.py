# SPDX-License-Identifier: GPL-3.0-or-later
"""Appending poses to a complete recording: it stays valid at every moment, also after an interruption."""

import json

import numpy as np
import pytest

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.recording.index import INDEX_NAME, REFINED, Source
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingExtension, RecordingWriter

from .limb import make_rig, random_poses, random_positions, recording_info

POSE_COUNT, ADDED_COUNT = 12, 5


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


def test_arrays_stay_plain_npy_files(recording):
    append_poses(recording, 1000)
    for name in ("pose_matrices", "positions"):
        assert len(np.load(recording / f"{name}.npy", mmap_mode="r", allow_pickle=False)) == POSE_COUNT + 1000
        assert (recording / f"{name}.npy").stat().st_size % 4 == 0


def test_poses_beyond_the_index_are_ignored_and_overwritten(recording):
    index_before = (recording / INDEX_NAME).read_bytes()
    append_poses(recording)
    # This is the state after the machine stopped between writing the arrays and writing the index.
    (recording / INDEX_NAME).write_bytes(index_before)
    assert_poses(recording)
    append_poses(recording, 3, seed=8)
    assert_poses(recording, (3, 8))


def test_bytes_beyond_the_header_are_ignored(recording):
    with open(recording / "positions.npy", "ab") as file:
        file.write(b"torn")
    assert_poses(recording)
    append_poses(recording)
    assert_poses(recording, (ADDED_COUNT, 7))


def test_an_array_shorter_than_its_header_says_is_refused(recording):
    append_poses(recording)
    index = json.loads((recording / INDEX_NAME).read_text())
    index["poses"] = index["complete"] = POSE_COUNT
    index["sampling"]["sources"].pop()
    (recording / INDEX_NAME).write_text(json.dumps(index))
    with open(recording / "positions.npy", "r+b") as file:
        file.truncate((recording / "positions.npy").stat().st_size - 4)
    with pytest.raises(RecordingError, match="truncated"):
        read_recording(recording)


def test_sources_that_contradict_the_pose_count_are_refused(recording):
    index = json.loads((recording / INDEX_NAME).read_text())
    index["sampling"]["sources"][0]["poses"] -= 1
    (recording / INDEX_NAME).write_text(json.dumps(index))
    with pytest.raises(RecordingError, match=f"its sources do not add up to its {POSE_COUNT} poses"):
        read_recording(recording)


def test_non_finite_values_append_nothing(recording):
    positions = random_positions(ADDED_COUNT)
    positions[3, 0, 0] = np.nan
    with (
        pytest.raises(RecordingError, match=rf"Pose {POSE_COUNT + 3} of the rig .* not numbers \(positions\)"),
        RecordingExtension(read_recording(recording), ADDED_COUNT, "limb.onnx") as extension,
    ):
        extension.append(random_poses(ADDED_COUNT), positions)
    assert_poses(recording)


def test_a_second_extension_at_the_same_time_is_refused(recording):
    with (
        RecordingExtension(read_recording(recording), ADDED_COUNT, "limb.onnx"),
        pytest.raises(RecordingError, match="This Blender is recording into"),
    ):
        RecordingExtension(read_recording(recording), ADDED_COUNT, "limb.onnx")
    append_poses(recording)
    assert_poses(recording, (ADDED_COUNT, 7))


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
