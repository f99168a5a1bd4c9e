# SPDX-License-Identifier: GPL-3.0-or-later
"""Each warning is found in a recording that was changed to cause it, and not in recordings without mistakes."""

import re
from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.checks.flips import find_similar_poses
from fdda_addon.core.checks.recording import check_recording, merges_sentence
from fdda_addon.core.checks.seams import check_seams
from fdda_addon.core.checks.target import check_target, unsettled_sentence
from fdda_addon.core.checks.warning import format_length
from fdda_addon.core.controls import Control
from fdda_addon.core.mathematics.partition import Partition, make_partitions
from fdda_addon.core.mathematics.poses import Channel
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.index import ACTION, RecordedTarget, Source, repeatability_sentence
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import STATIC_JOINT, Joint

from ..good_recording import (
    BONE_LENGTH,
    JOINTS,
    RING_COUNT,
    ROTATION_LIMIT,
    VERTICES_PER_RING,
    axis_rotations,
    good_recording,
    pose_rig,
    single_warning_text,
    warning_texts,
    with_partitions,
    with_positions,
    with_rig,
)


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


@pytest.mark.parametrize("seed", range(2))
def test_a_recording_without_mistakes_causes_no_warning(seed):
    assert check_recording(good_recording(seed=seed)) == []
    assert check_recording(good_recording(poses=12, seed=seed)) == []


def test_a_mesh_in_another_unit_is_reported(clean_recording):
    rig = clean_recording.rig
    text = single_warning_text(with_rig(clean_recording, rest_positions=rig.rest_positions * 20), "units")
    assert text.startswith(
        "The 4 joints that skin the mesh lie 750 mm apart and their vertices 15.3 m, 20.5 times as far"
    )


@pytest.mark.parametrize(("factor", "size"), [(200.0, "198 m"), (0.002, "2 mm")])
def test_a_character_in_another_unit_is_reported(clean_recording, factor, size):
    text = single_warning_text(scaled_recording(clean_recording, factor), "units")
    assert text.startswith(f"The mesh is {size} large, so errors and tolerances in mm mean little: set the unit scale")


@pytest.mark.parametrize("factor", [100.0, 200.0, 0.002])
def test_a_character_in_a_unit_that_is_set_causes_no_warning(clean_recording, factor):
    """A character in centimeters causes no warning if the unit of the scene or the scale of the object says so."""
    assert check_recording(with_rig(scaled_recording(clean_recording, factor), metres_per_unit=1 / factor)) == []


@pytest.mark.parametrize(("axis", "angle"), [(0, 90), (1, -90), (0, 180)])
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


def test_collapsed_joints_are_reported(clean_recording):
    local_transforms = axis_rotations(
        np.random.default_rng(1).uniform(-ROTATION_LIMIT, ROTATION_LIMIT, (200, len(JOINTS)))
    )
    local_transforms[[7, 50], 2, :3, :3] *= 0.01
    local_transforms[90, 3, :3, :3] *= -1
    clean_recording = replace(clean_recording, pose_matrices=pose_rig(clean_recording.rig, local_transforms))
    text = warning_texts(clean_recording)["degenerate-poses"]
    # The hand has the scale of its parent.
    assert text.startswith(
        "The 2 joints 'lower' and 'hand' have a scale near zero, huge or negative in the 3 poses 7, 50 and 90, volumes "
        "by a factor of 1e-06: "
    )
    local_transforms[[7, 50, 90]] = local_transforms[[8, 51, 91]]
    assert "degenerate-poses" not in warning_texts(
        replace(clean_recording, pose_matrices=pose_rig(clean_recording.rig, local_transforms))
    )


def test_a_control_that_moves_joints_causes_no_warning(clean_recording):
    """A switch between IK and FK changes the mesh only through the joints."""
    angles = np.random.default_rng(0).uniform(-ROTATION_LIMIT, ROTATION_LIMIT, (200, len(JOINTS)))
    switch_values = np.random.default_rng(7).integers(0, 2, 200)
    switched_recording = with_partitions(good_recording(angles=angles), controls=())
    assert "dead-controls" in warning_texts(switched_recording)
    for hand_angles in (
        np.where(switch_values, angles[:, 3], 0.4),
        np.where(switch_values, angles[:, 3], 0),
        angles[:, 3] + switch_values,
    ):
        switched_recording = with_partitions(
            good_recording(angles=np.column_stack([angles[:, :3], hand_angles])), controls=()
        )
        switched_recording.controls[:, 0] = switch_values
        assert "dead-controls" not in warning_texts(switched_recording)


def test_controls_that_change_nothing_are_reported(clean_recording):
    controls = (
        *clean_recording.rig.controls,
        Control("armature_object", '["fist"]', 0, 1),
        Control("armature", "x", 0, 1),
    )
    control_values = np.concatenate(
        [clean_recording.controls, clean_recording.controls[::-1], np.full((200, 1), 0.5)], axis=1
    ).astype(np.float32)
    with_unused_controls = replace(with_rig(clean_recording, controls=controls), controls=control_values)
    text = single_warning_text(with_unused_controls, "dead-controls")
    assert text.startswith(
        "The 2 controls 'armature_object/[\"fist\"]' and 'armature/x' change nothing in this recording, 'armature/x' "
        "of them always the same: leave them out"
    )
    assert "The control 'armature/x' changes nothing" in single_warning_text(
        replace(
            with_unused_controls, partitions=tuple(replace(p, controls=(0, 1)) for p in clean_recording.partitions)
        ),
        "dead-controls",
    )


def test_a_shape_key_that_never_moves_is_reported_with_what_drives_it(clean_recording):
    text = single_warning_text(replace(clean_recording, controls=np.zeros((200, 1), np.float32)), "dead-controls")
    assert text.startswith("The shape key 'Bulge' has one value in all poses, so a model cannot learn it: record")


def with_additional_joint(
    recording: SkinnedRecording, joint: Joint, local_transforms: np.ndarray, is_sampled: bool = True
) -> SkinnedRecording:
    """Return the recording with one additional joint that has no weights."""
    rig = recording.rig
    rest_matrices = np.concatenate([rig.rest_matrices, rig.rest_matrices[-1:]])
    changed_rig = replace(rig, joints=(*rig.joints, joint), rest_matrices=rest_matrices)
    joint_matrices = (
        recording.pose_matrices[:, joint.parent]
        @ np.linalg.inv(rest_matrices[joint.parent])
        @ rest_matrices[-1]
        @ local_transforms
    )
    matrices = np.concatenate([recording.pose_matrices, joint_matrices[:, None]], axis=1).astype(np.float32)
    sampling = recording.info.sampling
    channels = (*sampling.channels, Channel(joint.name, "rotation", 0, -1, 1)) if is_sampled else sampling.channels
    info = replace(recording.info, sampling=replace(sampling, channels=channels))
    return replace(recording, rig=changed_rig, pose_matrices=matrices, info=info)


def test_joints_that_move_no_vertex_are_reported(clean_recording):
    local_transforms = axis_rotations(np.random.default_rng(9).uniform(-1, 1, 200))
    with_helper = with_additional_joint(clean_recording, Joint("helper", 2), local_transforms)
    assert single_warning_text(with_helper, "dead-joints").startswith(
        "The joint 'helper' is sampled but moves no vertex: lock the axes that have a range, or leave"
    )
    # No warning: a joint that is not sampled, one that influences a partition, and one whose child has weights.
    assert (
        warning_texts(with_additional_joint(clean_recording, Joint("helper", 2), local_transforms, is_sampled=False))
        == {}
    )
    assert warning_texts(with_partitions(with_helper, influencing=(1, 2, 3, 4))) == {}
    # The channels of a control bone are inputs in place of the joint.
    controls = (Control("armature_object", 'pose.bones["helper"].location[1]', 0, 1),)
    with_control = with_rig(with_helper, controls=controls)
    partitions = tuple(replace(partition, controls=(0,)) for partition in with_control.partitions)
    values = np.random.default_rng(1).uniform(0, 1, (200, 1)).astype(np.float32)
    assert "dead-joints" not in warning_texts(replace(with_control, partitions=partitions, controls=values))
    without_root_weights = with_rig(clean_recording, skin_joints=np.maximum(clean_recording.rig.skin_joints, 1))
    partitions = tuple(p for p in clean_recording.partitions if p.joint)
    assert "dead-joints" not in warning_texts(replace(without_root_weights, partitions=partitions))


def test_a_joint_that_drives_another_causes_no_warning(clean_recording):
    """An IK target drives joints that are not sampled themselves."""
    angles = np.random.default_rng(9).uniform(-1, 1, 200)
    with_target = with_additional_joint(clean_recording, Joint("target", 0), axis_rotations(angles))
    assert "dead-joints" in warning_texts(with_target)
    channels = tuple(channel for channel in with_target.info.sampling.channels if channel.name != "hand")
    sampling = replace(with_target.info.sampling, channels=channels)
    with_target = replace(with_target, info=replace(with_target.info, sampling=sampling))
    assert "dead-joints" in warning_texts(with_target)
    with_target.pose_matrices[:, 3] = (
        with_target.pose_matrices[:, 2]
        @ np.linalg.inv(clean_recording.rig.rest_matrices[2])
        @ (clean_recording.rig.rest_matrices[3] @ axis_rotations(0.5 * angles + 0.1))
    )
    assert "dead-joints" not in warning_texts(with_target)


def flipping_recording(pose_count: int, half_rotations: float, jump_metres: float, seed: int = 0) -> SkinnedRecording:
    """Return the tube with a lower joint that rotates by up to `half_rotations` times 180 degrees.

    Past 180 degrees the residuals near the joint jump by `jump_metres`.
    """
    angles = np.random.default_rng(seed).uniform(-ROTATION_LIMIT, ROTATION_LIMIT, (pose_count, len(JOINTS)))
    angles[:, 2] *= half_rotations * np.pi / ROTATION_LIMIT
    recording = good_recording(angles=angles)
    # Past 180 degrees, the shorter rotation to the same orientation has the opposite sign.
    wrapped_angles = np.mod(angles[:, 2] + np.pi, 2 * np.pi) - np.pi
    falloff = np.exp(-(((recording.rig.rest_positions[:, 2] / BONE_LENGTH - 2) / 0.4) ** 2))
    recording.residuals[:, :, 0] += jump_metres * (wrapped_angles / (2 * np.pi))[:, None] * falloff
    return recording


@pytest.mark.parametrize("poses", [100, 300, 1500])
def test_a_flipping_joint_is_reported(poses):
    text = single_warning_text(flipping_recording(poses, 1.1, 0.08), "flips")
    assert re.match(
        r"Vertices of '(upper|lower)' jump up to \d\d mm between similar poses, 'lower' on the two sides of 180 "
        r"degrees \(\d+ pairs?, such as poses \d+ and \d+\); [12] more partitions? jumps? too, and no network can "
        "learn a jump: keep its rotation below 180 degrees",
        text,
    )


@pytest.mark.parametrize(("half_rotations", "jump_metres"), [(0.95, 0.08), (1.1, 0.0), (0.5, 0.3), (1.1, 0.0005)])
def test_smooth_and_tiny_changes_are_no_flips(half_rotations, jump_metres):
    for seed in range(3):
        assert "flips" not in warning_texts(flipping_recording(400, half_rotations, jump_metres, seed))


def test_a_fast_change_by_another_joint_is_no_flip():
    """The hand drives a shape in a tenth of the poses, fast but without a jump, while the lower joint rotates."""
    for seed in range(3):
        angles = np.random.default_rng(seed).uniform(-ROTATION_LIMIT, ROTATION_LIMIT, (400, len(JOINTS)))
        recording = flipping_recording(400, 1.1, 0.0, seed)
        shape_values = np.clip((angles[:, 3] - 0.6) / 0.2, 0, 1)
        recording.residuals[:, :, 2] += 0.06 * shape_values[:, None]
        recording = with_partitions(recording, influencing=(1, 2, 3))
        assert "flips" not in warning_texts(recording)


@pytest.fixture
def dense_recording() -> SkinnedRecording:
    """A recording of 1,000 poses, so that each pose has neighbors in all inputs of its partition."""
    return good_recording(1000)


def test_a_switching_control_is_reported(dense_recording):
    falloff = np.exp(-((dense_recording.rig.rest_positions[:, 2] / BONE_LENGTH - 1.5) ** 2))
    dense_recording.residuals[:, :, 1] += 0.05 * (dense_recording.controls > 0.6) * falloff
    text = single_warning_text(dense_recording, "flips")
    assert re.search(r"jump up to \d\d mm between similar poses \(\d+ pairs, such as poses \d+ and \d+\)", text)
    assert "a jump: look for what switches there, a driver or a Shrinkwrap" in text


def test_a_jump_far_from_180_degrees_is_reported(dense_recording):
    """A Shrinkwrap modifier jumps like this where its nearest point changes to another part of the target."""
    local_rotations = np.linalg.inv(dense_recording.pose_matrices[:, 1]) @ dense_recording.pose_matrices[:, 2]
    vertices = dense_recording.partitions[1].vertices
    dense_recording.residuals[:, vertices, 2] += np.where(local_rotations[:, 2, 1] > 0.3, 0.04, 0.0)[:, None].astype(
        np.float32
    )
    text = single_warning_text(dense_recording, "flips")
    assert text.startswith("Vertices of 'upper' jump up to 4") and "180" not in text
    # The same change, spread over a fifth of the range, is no jump.
    smooth_values = np.clip((local_rotations[:, 2, 1] - 0.2) / 0.3, 0, 1)
    dense_recording.residuals[:, vertices, 2] += 0.04 * (smooth_values - (local_rotations[:, 2, 1] > 0.3))[:, None]
    assert warning_texts(dense_recording) == {}


def test_equal_poses_are_not_paired():
    inputs = np.repeat(np.random.default_rng(0).uniform(0, 1, (100, 1)), 3, axis=0)
    pairs = find_similar_poses(inputs, 0.2)
    assert len(pairs) and (inputs[pairs[:, 0]] != inputs[pairs[:, 1]]).all()


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


@pytest.mark.parametrize("factor, offset", [(1e-3, 0.0), (1000.0, 1e5)])
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


def target_warning_text(recording: SkinnedRecording, name: str) -> str:
    """Check that the target causes one warning, of this name, and return its text."""
    (warning,) = check_target(recording)
    assert warning.name == name
    return warning.text


def test_a_target_that_follows_the_rig_causes_no_warning(swinging_recording):
    assert check_target(swinging_recording) == []


def test_a_cache_that_ends_before_the_action_is_reported(swinging_recording):
    positions = target_positions(swinging_recording)
    positions[35:] = positions[34]
    text = target_warning_text(with_positions(swinging_recording, positions), "frozen-frames")
    assert "stands still in 5 frames in which the rig moves: 'swing 40', 'swing 41', " in text


def test_jumps_in_a_frame_are_reported(swinging_recording):
    positions = target_positions(swinging_recording)
    positions[20, 100] += (0.0, 0.3, 0.0)
    text = target_warning_text(with_positions(swinging_recording, positions), "frame-jumps")
    assert text.startswith("The target jumps in 2 frames, by up to 30")
    assert "'swing 25'" in text and "'swing 26'" in text


@pytest.mark.parametrize(("factor", "offset"), [(100.0, 0.0), (0.01, 0.0), (1.0, 3.0)])
def test_a_target_in_other_units_or_at_another_location_is_reported(factor, offset, swinging_recording):
    text = target_warning_text(
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
    assert target_warning_text(with_repeatability(mean), "hysteresis").startswith(
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
