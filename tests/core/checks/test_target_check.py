# SPDX-License-Identifier: GPL-3.0-or-later
"""The target of a recording: its data in the index, and the warnings about it."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.checks.target import check_target, unsettled_sentence
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.index import ACTION, RecordedTarget, Source, repeatability_sentence
from fdda_addon.core.recording.skinned import SkinnedRecording

from ..good_recording import good_recording, with_positions

FRAME_COUNT = 40
TARGET = RecordedTarget("flesh", "frames")


@pytest.fixture
def swinging_recording() -> SkinnedRecording:
    """A recording of an action from frame 5 on: the joints swing smoothly, and the target bulges with them."""
    angles = 0.6 * np.sin(np.linspace(0, 6, FRAME_COUNT))[:, None] * np.ones(4)
    recording = good_recording(angles=angles)
    sampling = replace(recording.info.sampling, sources=(Source(ACTION, FRAME_COUNT, "swing", (5, 1)),))
    controls = np.full((FRAME_COUNT, 1), 0.5, np.float32)
    residuals = recording.residuals.copy()
    residuals[:, :, 1] = 0
    recording = replace(recording, controls=controls, residuals=residuals)
    return replace(recording, info=replace(recording.info, sampling=sampling, target=TARGET))


def target_positions(recording: SkinnedRecording) -> np.ndarray:
    """Return the (N, V, 3) recorded positions of the target."""
    skinning = LinearSkinning(recording.rig, recording.partitions)
    return skinning.complex_positions(recording.pose_matrices, recording.residuals)


def single_warning_text(recording: SkinnedRecording, name: str) -> str:
    """Check that the target causes one warning, of this name, and return its text."""
    (warning,) = check_target(recording)
    assert warning.name == name
    return warning.text


def test_a_target_that_follows_the_rig_causes_no_warning(swinging_recording):
    assert check_target(swinging_recording) == []


def test_a_recording_without_a_target_is_not_checked(swinging_recording):
    info = replace(swinging_recording.info, target=None)
    assert (
        check_target(replace(with_positions(swinging_recording, target_positions(swinging_recording) * 100), info=info))
        == []
    )


def test_a_cache_that_ends_before_the_action_is_reported(swinging_recording):
    positions = target_positions(swinging_recording)
    positions[35:] = positions[34]
    text = single_warning_text(with_positions(swinging_recording, positions), "frozen-frames")
    assert "stands still in 5 frames in which the rig moves: 'swing 40', 'swing 41', " in text


def test_jumps_in_a_frame_are_reported(swinging_recording):
    positions = target_positions(swinging_recording)
    positions[20, 100] += (0.0, 0.3, 0.0)
    text = single_warning_text(with_positions(swinging_recording, positions), "frame-jumps")
    assert text.startswith("The target jumps in 2 frames, by up to 30")
    assert "'swing 25'" in text and "'swing 26'" in text


@pytest.mark.parametrize(("factor", "offset"), [(100.0, 0.0), (0.01, 0.0), (1.0, 3.0)])
def test_a_target_in_other_units_or_at_another_location_is_reported(factor, offset, swinging_recording):
    text = single_warning_text(
        with_positions(swinging_recording, target_positions(swinging_recording) * factor + (offset, 0, 0)),
        "target-place",
    )
    assert text.startswith("The target 'flesh' is ") and "it has another unit or location" in text


def test_a_low_repeatability_is_reported(swinging_recording):
    def with_repeatability(mm: float) -> SkinnedRecording:
        return replace(swinging_recording, info=replace(swinging_recording.info, repeatability_mm=mm))

    linear_mm = 1000 * np.linalg.norm(swinging_recording.residuals[:10], axis=2).mean()
    assert check_target(with_repeatability(0.19 * linear_mm)) == []
    mean = 0.21 * linear_mm
    assert single_warning_text(with_repeatability(mean), "hysteresis").startswith(
        f"The target is {mean:.2g} mm from itself when the same pose is"
    )
    assert repeatability_sentence(1.1).startswith("The same pose from two directions: 1.1 mm apart on average. No")


def test_sentence_about_unsettled_poses():
    assert unsettled_sentence({"complete": 9}) == ""
    index = {"complete": 9, "unsettled": [1, 4], "target": {"settle_frames": 30}}
    assert unsettled_sentence(index).startswith("2 of 9 poses did not come to rest in 30 frames: 1 and 4. A training")


def test_target_is_read_back_from_json():
    simulation_target = RecordedTarget("flesh", "simulation", 3, 60, 0.1)
    assert RecordedTarget.from_json(simulation_target.to_json()) == simulation_target
    assert RecordedTarget.from_json(TARGET.to_json()) == TARGET
    with pytest.raises(ValueError, match=r"target\.follows is 'wind'"):
        RecordedTarget.from_json(simulation_target.to_json() | {"follows": "wind"})
