# SPDX-License-Identifier: GPL-3.0-or-later
"""A short run of `benchmarks/stress_playback.py`: characters show the output of their model after any operation."""

import sys

import bpy
import pytest

from benchmarks.stress_playback import MAX_DIFFERENCE_M, OPERATION_WEIGHTS, PlaybackStress


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_random_operations_leave_correct_playback_and_no_memory(bound_elbow, elbow_files, tmp_path, seed):
    bpy.context.scene.frame_set(1)
    outcome = PlaybackStress(bound_elbow, {"": elbow_files.model}, 6, tmp_path, seed).run(250)
    assert outcome.largest_difference < MAX_DIFFERENCE_M, outcome.worst_case
    assert outcome.compared_count > 600 and len(outcome.operations) == len(OPERATION_WEIGHTS)
    # What was allocated once stays; a character more or less is below a megabyte.
    half = len(outcome.memory_mb) // 2
    # Only Linux says what a process holds.
    assert sys.platform != "linux" or outcome.memory_mb[-1] - outcome.memory_mb[half] < 10
