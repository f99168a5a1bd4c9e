# SPDX-License-Identifier: GPL-3.0-or-later
"""Warnings about joints and controls that collapse, or that change nothing."""

from dataclasses import replace

import numpy as np

from fdda_addon.core.controls import Control
from fdda_addon.core.mathematics.poses import Channel
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import Joint

from .good_recording import (
    JOINTS,
    ROTATION_LIMIT,
    axis_rotations,
    good_recording,
    pose_rig,
    single_warning_text,
    warning_texts,
    with_partitions,
    with_rig,
)


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
