# SPDX-License-Identifier: GPL-3.0-or-later
"""Each warning is found in a recording that was changed to cause it, and not in recordings without mistakes."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.checks.recording import check_recording, merges_sentence
from fdda_addon.core.checks.warning import format_length
from fdda_addon.core.mathematics.partition import Partition, make_partitions
from fdda_addon.core.recording.index import Source
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import STATIC_JOINT, Joint

from .good_recording import (
    axis_rotations,
    good_recording,
    single_warning_text,
    warning_texts,
    with_rig,
)

FORMATS_PAGE = Path(__file__).resolve().parents[2] / "docs" / "formats.md"


def scaled_recording(recording: SkinnedRecording, factor: float) -> SkinnedRecording:
    """Return the recording of the same character, scaled by a factor."""
    rest_matrices, pose_matrices = recording.rig.rest_matrices.copy(), recording.pose_matrices.copy()
    for matrices in (rest_matrices, pose_matrices):
        matrices[..., :3, 3] *= factor
    with_scaled_rig = with_rig(
        recording, rest_matrices=rest_matrices, rest_positions=recording.rig.rest_positions * factor
    )
    return replace(with_scaled_rig, pose_matrices=pose_matrices, residuals=recording.residuals * factor)


def with_sources(recording: SkinnedRecording, *sources: Source) -> SkinnedRecording:
    """Return the recording with other sources of its poses."""
    sampling = replace(recording.info.sampling, sources=sources)
    return replace(recording, info=replace(recording.info, sampling=sampling))


@pytest.mark.parametrize("seed", range(5))
def test_a_recording_without_mistakes_causes_no_warning(seed):
    assert check_recording(good_recording(seed=seed)) == []
    assert check_recording(good_recording(poses=12, seed=seed)) == []


def test_a_mesh_in_another_unit_is_reported(clean_recording):
    rig = clean_recording.rig
    text = single_warning_text(with_rig(clean_recording, rest_positions=rig.rest_positions * 20), "units")
    assert text.startswith(
        "The 4 joints that skin the mesh lie 750 mm apart and their vertices 15.3 m, 20.5 times as far"
    )
    small_pose_matrices = clean_recording.pose_matrices.copy()
    small_pose_matrices[:, :, :3, 3] *= 0.01
    rest_matrices = rig.rest_matrices.copy()
    rest_matrices[:, :3, 3] *= 0.01
    assert "102 times as far" in single_warning_text(
        with_rig(replace(clean_recording, pose_matrices=small_pose_matrices), rest_matrices=rest_matrices), "units"
    )


@pytest.mark.parametrize(("factor", "size"), [(200.0, "198 m"), (0.002, "2 mm")])
def test_a_character_in_another_unit_is_reported(clean_recording, factor, size):
    text = single_warning_text(scaled_recording(clean_recording, factor), "units")
    assert text.startswith(f"The mesh is {size} large, so errors and tolerances in mm mean little: set the unit scale")


@pytest.mark.parametrize("factor", [100.0, 200.0, 0.002])
def test_a_character_in_a_unit_that_is_set_causes_no_warning(clean_recording, factor):
    """A character in centimeters causes no warning if the unit of the scene or the scale of the object says so."""
    assert check_recording(with_rig(scaled_recording(clean_recording, factor), metres_per_unit=1 / factor)) == []


def test_a_character_of_implausible_size_in_its_unit_is_reported(clean_recording):
    text = single_warning_text(with_rig(scaled_recording(clean_recording, 20_000.0), metres_per_unit=0.01), "units")
    assert text.startswith("The mesh is 198 m large, ")


@pytest.mark.parametrize(("axis", "angle"), [(0, 90), (0, -90), (1, 90), (1, -90), (0, 180)])
def test_a_mesh_with_other_axes_is_reported(clean_recording, axis, angle):
    rotation = axis_rotations(np.radians(np.array(angle)), axis)[:3, :3]
    text = single_warning_text(
        with_rig(clean_recording, rest_positions=(clean_recording.rig.rest_positions @ rotation.T).astype(np.float32)),
        "axes",
    )
    assert re.search("of the 4 joints that skin the mesh lie outside its bounds.* most of it along [+-][XYZ]: ", text)


def test_a_mesh_at_another_location_is_reported(clean_recording):
    moved_positions = clean_recording.rig.rest_positions + np.array([0, -0.8, 0], np.float32)
    text = single_warning_text(with_rig(clean_recording, rest_positions=moved_positions), "axes")
    assert text.startswith(
        "4 of the 4 joints that skin the mesh lie outside its bounds, and joints lie 753 mm from the nearest vertex "
        "that follows them (median), most of it along -Y: "
    )


def test_joints_without_weights_may_lie_anywhere(clean_recording):
    rest_matrices = clean_recording.rig.rest_matrices.copy()
    rest_matrices[0, :3, 3] = 0, 0, -0.4
    # The root deforms no vertex, but it is the ancestor of the other joints.
    skin_joints = np.maximum(clean_recording.rig.skin_joints, 1)
    changed_recording = with_rig(clean_recording, rest_matrices=rest_matrices, skin_joints=skin_joints)
    assert "axes" not in warning_texts(replace(changed_recording, partitions=make_partitions(changed_recording.rig)))


def test_residuals_larger_than_bones_are_reported(clean_recording):
    residuals = clean_recording.residuals.copy()
    vertices = clean_recording.partitions[2].vertices
    residuals[:, vertices] += 0.4
    text = single_warning_text(replace(clean_recording, residuals=residuals), "large-residuals")
    assert text.startswith(
        "Residuals are larger than bones and vertices of 1 of 4 partitions, most of 'lower', 696 mm rms where bone and "
        "vertices are 254 mm long: "
    )
    assert text.endswith("or have weights fitted (--base-skinning smooth).")


def test_one_huge_residual_is_reported(clean_recording):
    clean_recording.residuals[17, 33] = 3, 4, 0
    text = warning_texts(clean_recording)["large-residuals"]
    assert text.startswith("The residual of vertex 33 is 5 m in pose 17, and the character is 990 mm large: ")


def test_duplicate_poses_are_reported(clean_recording):
    for array in (clean_recording.pose_matrices, clean_recording.controls, clean_recording.residuals):
        array[150:190] = array[150]
    text = single_warning_text(
        with_sources(clean_recording, Source("random", 120), Source("action", 80, "idle", (1, 1))), "duplicate-poses"
    )
    assert text.startswith(
        "39 of 200 poses repeat an earlier one, such as pose 151 pose 150, 39 of them of the action 'idle': "
    )
    clean_recording.controls[150:190, 0] = np.linspace(0, 1, 40)
    assert "duplicate-poses" not in warning_texts(clean_recording)


def test_a_few_duplicate_poses_cause_no_warning(clean_recording):
    for array in (clean_recording.pose_matrices, clean_recording.controls, clean_recording.residuals):
        array[190:] = array[:10]
    assert warning_texts(clean_recording) == {}


def test_equal_poses_with_different_residuals_are_reported(clean_recording):
    for array in (clean_recording.pose_matrices, clean_recording.controls, clean_recording.residuals):
        array[190:193] = array[10:13]
    clean_recording.residuals[191, 5:9, 2] += 0.012
    text = single_warning_text(clean_recording, "hidden-inputs")
    assert text.startswith(
        "Poses 11 and 191 have the same joints and controls and yet vertices lie up to 12 mm apart: "
    )


def test_sentence_about_merged_partitions(clean_recording):
    joints = tuple(Joint(name, -1) for name in ("root", "a", "b", STATIC_JOINT, *map(str, range(20))))
    recording = with_rig(clean_recording, joints=joints)

    def sentence(merged: tuple[int, ...], min_vertices: int) -> str:
        partitions = Partition(0, (), np.zeros(1, int), merged=merged), Partition(1, (), np.ones(1, int))
        return merges_sentence(replace(recording, partitions=partitions), min_vertices)

    assert sentence((), 8) == ""
    assert sentence((2, 3), 8) == (
        "2 partitions of fewer than 8 vertices are merged: 'b' into 'root', 'no bone' into 'root'."
    )
    assert sentence(tuple(range(4, 20)), 5).endswith("'8' into 'root', '9' into 'root' and 6 more.")


def test_lengths_are_formatted_in_meters_for_any_unit(clean_recording):
    texts = ["0.04 mm", "87 mm", "250 mm", "1.23 m"]
    for meters in (1.0, 0.01):
        rig = with_rig(clean_recording, metres_per_unit=meters).rig
        assert [format_length(rig, m / meters) for m in (0.00004, 0.0871, 0.25, 1.234)] == texts
