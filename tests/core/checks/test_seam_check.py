# SPDX-License-Identifier: GPL-3.0-or-later
"""The warning about vertices that lie on each other at rest and come apart."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.checks.seams import check_seams
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.recording.skinned import SkinnedRecording

from ..good_recording import RING_COUNT, VERTICES_PER_RING, single_warning_text, warning_texts, with_rig

GAP_RATIO = 0.01
"""Distance of torn vertices, as a part of the size of the character."""


def tube_faces(step: int) -> dict[str, np.ndarray]:
    """Return quads between the rings. With a step of 2, no two quads share a vertex; with 1, they share their edges."""
    ring, place = np.mgrid[: RING_COUNT - 1 : step, :VERTICES_PER_RING:step].reshape(2, -1)
    following = (place + 1) % VERTICES_PER_RING
    corners = [(ring, place), (ring, following), (ring + 1, following), (ring + 1, place)]
    vertices = np.stack([r * VERTICES_PER_RING + p for r, p in corners], axis=1).astype(np.int32)
    return {"face_vertices": vertices.ravel(), "face_starts": np.arange(0, vertices.size, 4, dtype=np.int32)}


@pytest.fixture
def cut_recording(clean_recording) -> SkinnedRecording:
    """A recording in which each of the first 40 vertices lies on one of the last 40, and moves with it.

    Each quad has vertices of its own.
    """
    rig = clean_recording.rig
    sources = np.append(np.arange(rig.vertex_count - 40), np.arange(40))
    changed = with_rig(
        clean_recording,
        rest_positions=rig.rest_positions[sources],
        skin_joints=rig.skin_joints[sources],
        skin_weights=rig.skin_weights[sources],
        **tube_faces(step=2),
    )
    influencing = {partition.joint: partition.influencing for partition in clean_recording.partitions}
    controls = {partition.joint: partition.controls for partition in clean_recording.partitions}
    partitions = make_partitions(changed.rig, influencing, controls)
    return replace(changed, partitions=partitions, residuals=clean_recording.residuals[:, sources].copy())


def test_vertices_that_come_apart_are_reported(cut_recording):
    cut_recording.residuals[1:, -20:, 0] += GAP_RATIO * cut_recording.rig.size
    text = single_warning_text(cut_recording, "open-seams")
    # Each of the 20 moved vertices leaves one that stays.
    assert text.startswith("40 of 240 vertices lie on others along cuts of the mesh and come apart by up to 8.2 mm: ")
    assert "Merge > By Distance, with Sharp Edges on" in text


def test_one_pose_is_enough(cut_recording):
    cut_recording.residuals[-1, -20:, 1] -= GAP_RATIO * cut_recording.rig.size
    assert "open-seams" in warning_texts(cut_recording)


def test_vertices_that_stay_together_cause_no_warning(cut_recording):
    assert warning_texts(cut_recording) == {}
    cut_recording.residuals[1:, -20:, 0] += 0.1 * 1e-3 * cut_recording.rig.size
    assert warning_texts(cut_recording) == {}


def test_a_few_torn_vertices_cause_no_warning(cut_recording):
    cut_recording.residuals[1:, -1, 0] += GAP_RATIO * cut_recording.rig.size
    assert warning_texts(cut_recording) == {}


def test_vertices_with_other_skin_weights_may_come_apart(cut_recording):
    weights = cut_recording.rig.skin_weights.copy()
    weights[-40:] = weights[-40:] * 0.99
    changed = with_rig(cut_recording, skin_weights=weights)
    changed.residuals[1:, -20:, 0] += GAP_RATIO * cut_recording.rig.size
    assert warning_texts(changed) == {}


def test_the_same_gap_in_all_poses_causes_no_warning(cut_recording):
    cut_recording.residuals[:, -20:, 0] += GAP_RATIO * cut_recording.rig.size
    assert warning_texts(cut_recording) == {}


def test_surfaces_that_touch_without_a_cut_cause_no_warning(cut_recording):
    """Closed lids, or two shells: where they touch, each of them continues on both sides."""
    touching = with_rig(cut_recording, **tube_faces(step=1))
    touching.residuals[1:, -20:, 0] += GAP_RATIO * touching.rig.size
    assert warning_texts(touching) == {}


def test_a_recording_without_faces_causes_no_warning(cut_recording):
    unknown = with_rig(cut_recording, face_starts=np.zeros(0, np.int32), face_vertices=np.zeros(0, np.int32))
    unknown.residuals[1:, -20:, 0] += GAP_RATIO * unknown.rig.size
    assert warning_texts(unknown) == {}


@pytest.mark.parametrize("factor, offset", [(1000.0, 0.0), (1e-3, 0.0), (1.0, 100.0), (1000.0, 1e5)])
def test_cuts_are_found_in_other_units_and_far_from_the_origin(cut_recording, factor, offset):
    rig = cut_recording.rig
    moved = with_rig(
        cut_recording,
        rest_positions=(rig.rest_positions * factor + offset).astype(np.float32),
        metres_per_unit=1 / factor,
    )
    moved = replace(moved, residuals=cut_recording.residuals * np.float32(factor))
    moved.residuals[1:, -20:, 0] += GAP_RATIO * moved.rig.size
    (warning,) = check_seams(moved)
    assert warning.text.startswith("40 of 240 vertices") and "up to 8.2 mm" in warning.text


def test_the_order_of_the_vertex_groups_does_not_matter(cut_recording):
    joints, weights = cut_recording.rig.skin_joints.copy(), cut_recording.rig.skin_weights.copy()
    is_tie = weights[-40:, 0] == weights[-40:, 1]
    assert not is_tie.any()
    joints[-40:], weights[-40:] = joints[-40:, ::-1].copy(), weights[-40:, ::-1].copy()
    changed = with_rig(cut_recording, skin_joints=joints, skin_weights=weights)
    changed.residuals[1:, -20:, 0] += GAP_RATIO * changed.rig.size
    assert [warning.name for warning in check_seams(changed)] == ["open-seams"]
