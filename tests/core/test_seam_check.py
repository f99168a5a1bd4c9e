# SPDX-License-Identifier: GPL-3.0-or-later
"""The warning about vertices that lie on each other at rest and come apart."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.partition import make_partitions
from fdda_addon.core.recording.reader import Recording

from .good_recording import single_warning_text, warning_texts, with_rig

GAP_RATIO = 0.01
"""Distance of torn vertices, as a part of the size of the character."""


@pytest.fixture
def cut_recording(clean_recording) -> Recording:
    """A recording in which each of the first 40 vertices lies on one of the last 40, and moves with it."""
    rig = clean_recording.rig
    sources = np.append(np.arange(rig.vertex_count - 40), np.arange(40))
    changed = with_rig(
        clean_recording,
        rest_positions=rig.rest_positions[sources],
        skin_joints=rig.skin_joints[sources],
        skin_weights=rig.skin_weights[sources],
    )
    influencing = {partition.joint: partition.influencing for partition in clean_recording.partitions}
    controls = {partition.joint: partition.controls for partition in clean_recording.partitions}
    partitions = make_partitions(changed.rig, influencing, controls)
    return replace(changed, partitions=partitions, residuals=clean_recording.residuals[:, sources].copy())


def test_vertices_that_come_apart_are_reported(cut_recording):
    cut_recording.residuals[:, -20:, 0] += GAP_RATIO * cut_recording.rig.size
    text = single_warning_text(cut_recording, "open-seams")
    # Each of the 20 moved vertices leaves one that stays.
    assert text.startswith("40 of 240 vertices lie on other vertices and come apart from them, by up to ")
    assert "Merge > By Distance" in text


def test_one_pose_is_enough(cut_recording):
    cut_recording.residuals[-1, -20:, 1] -= GAP_RATIO * cut_recording.rig.size
    assert "open-seams" in warning_texts(cut_recording)


def test_vertices_that_stay_together_cause_no_warning(cut_recording):
    assert warning_texts(cut_recording) == {}
    cut_recording.residuals[:, -20:, 0] += 0.1 * 1e-3 * cut_recording.rig.size
    assert warning_texts(cut_recording) == {}


def test_a_few_torn_vertices_cause_no_warning(cut_recording):
    cut_recording.residuals[:, -1, 0] += GAP_RATIO * cut_recording.rig.size
    assert warning_texts(cut_recording) == {}


def test_vertices_with_other_skin_weights_may_come_apart(cut_recording):
    weights = cut_recording.rig.skin_weights.copy()
    weights[-40:] = weights[-40:] * 0.99
    changed = with_rig(cut_recording, skin_weights=weights)
    changed.residuals[:, -20:, 0] += GAP_RATIO * cut_recording.rig.size
    assert warning_texts(changed) == {}
