# SPDX-License-Identifier: GPL-3.0-or-later
"""Appending poses to a complete recording: it stays valid at every moment, also after an interruption."""

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
