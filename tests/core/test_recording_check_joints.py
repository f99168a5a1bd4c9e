# SPDX-License-Identifier: GPL-3.0-or-later
"""Warnings about joints and controls of a recording."""

from dataclasses import replace

import numpy as np

from fdda_addon.core.controls import Control
from fdda_addon.core.partition import make_partitions
from fdda_addon.core.poses import Channel
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.rig import STATIC_JOINT, Joint

from .good_recording import (
    JOINTS,
    LIMIT,
    good_recording,
    only,
    pose_rig,
    turns,
    warned,
    with_partitions,
    with_rig,
)


def test_joints_that_collapse(good):
    local = turns(np.random.default_rng(1).uniform(-LIMIT, LIMIT, (200, len(JOINTS))))
    local[[7, 50], 2, :3, :3] *= 0.01
    local[90, 3, :3, :3] *= -1
    good = replace(good, pose_matrices=pose_rig(good.rig, local))
    text = warned(good)["degenerate-poses"]
    # The hand shrinks with its parent.
    assert text.startswith(
        "The 2 joints 'lower' and 'hand' have a scale near zero, huge or negative in the 3 poses 7, 50 and 90, volumes "
        "by a factor of 1e-06: "
    )
    local[[7, 50, 90]] = local[[8, 51, 91]]
    assert "degenerate-poses" not in warned(replace(good, pose_matrices=pose_rig(good.rig, local)))


def test_a_control_that_moves_joints_is_not_dead(good):
    """As a switch between IK and FK: what it does to the mesh is in the joints."""
    angles = np.random.default_rng(0).uniform(-LIMIT, LIMIT, (200, len(JOINTS)))
    switch = np.random.default_rng(7).integers(0, 2, 200)
    moved = with_partitions(good_recording(angles=angles), controls=())
    assert "dead-controls" in warned(moved)
    for changed in (np.where(switch, angles[:, 3], 0.4), np.where(switch, angles[:, 3], 0), angles[:, 3] + switch):
        moved = with_partitions(good_recording(angles=np.column_stack([angles[:, :3], changed])), controls=())
        moved.controls[:, 0] = switch
        assert "dead-controls" not in warned(moved)


def test_controls_that_change_nothing(good):
    controls = (*good.rig.controls, Control("armature_object", '["fist"]', 0, 1), Control("armature", "x", 0, 1))
    values = np.concatenate([good.controls, good.controls[::-1], np.full((200, 1), 0.5)], axis=1).astype(np.float32)
    with_idle = replace(with_rig(good, controls=controls), controls=values)
    text = only(with_idle, "dead-controls")
    assert text.startswith(
        "The 2 controls 'armature_object/[\"fist\"]' and 'armature/x' change nothing in this recording, 'armature/x' "
        "of them always the same: leave them out"
    )
    assert "The control 'armature/x' changes nothing" in only(
        replace(with_idle, partitions=tuple(replace(p, controls=(0, 1)) for p in good.partitions)), "dead-controls"
    )


def with_joint(recording: Recording, joint: Joint, local: np.ndarray, sampled: bool = True) -> Recording:
    """The recording with one joint more, which skins nothing."""
    rig = recording.rig
    rest = np.concatenate([rig.rest_matrices, rig.rest_matrices[-1:]])
    changed = replace(rig, joints=(*rig.joints, joint), rest_matrices=rest)
    pose = recording.pose_matrices[:, joint.parent] @ np.linalg.inv(rest[joint.parent]) @ rest[-1] @ local
    matrices = np.concatenate([recording.pose_matrices, pose[:, None]], axis=1).astype(np.float32)
    sampling = recording.info.sampling
    channels = (*sampling.channels, Channel(joint.name, "rotation", 0, -1, 1)) if sampled else sampling.channels
    info = replace(recording.info, sampling=replace(sampling, channels=channels))
    return replace(recording, rig=changed, pose_matrices=matrices, info=info)


def test_joints_that_move_nothing(good):
    local = turns(np.random.default_rng(9).uniform(-1, 1, 200))
    extra = with_joint(good, Joint("helper", 2), local)
    assert only(extra, "dead-joints").startswith("The joint 'helper' is sampled but moves no vertex: lock all axes")
    # One that was not sampled, one that influences a partition, and one whose child skins.
    assert warned(with_joint(good, Joint("helper", 2), local, sampled=False)) == {}
    assert warned(with_partitions(extra, influencing=(1, 2, 3, 4))) == {}
    root_skins_nothing = with_rig(good, skin_joints=np.maximum(good.rig.skin_joints, 1))
    partitions = tuple(p for p in good.partitions if p.joint)
    assert "dead-joints" not in warned(replace(root_skins_nothing, partitions=partitions))


def test_a_joint_that_drives_another_is_not_dead(good):
    """As the target of an inverse kinematics does: what it drives is not sampled."""
    angles = np.random.default_rng(9).uniform(-1, 1, 200)
    driving = with_joint(good, Joint("target", 0), turns(angles))
    assert "dead-joints" in warned(driving)
    channels = tuple(channel for channel in driving.info.sampling.channels if channel.name != "hand")
    sampling = replace(driving.info.sampling, channels=channels)
    driving = replace(driving, info=replace(driving.info, sampling=sampling))
    assert "dead-joints" in warned(driving)
    driving.pose_matrices[:, 3] = (
        driving.pose_matrices[:, 2]
        @ np.linalg.inv(good.rig.rest_matrices[2])
        @ (good.rig.rest_matrices[3] @ turns(0.5 * angles + 0.1))
    )
    assert "dead-joints" not in warned(driving)


def test_vertices_without_a_bone(good):
    rest = np.concatenate([good.rig.rest_matrices, np.eye(4, dtype=np.float32)[None]])
    still = np.tile(np.eye(4, dtype=np.float32), (200, 1, 1, 1))
    skin_joints, skin_weights = good.rig.skin_joints.copy(), good.rig.skin_weights.copy()
    skin_joints[-20:], skin_weights[-20:] = 4, (1, 0)
    good.residuals[:, -20:] = 0
    joints = (*good.rig.joints, Joint(STATIC_JOINT, -1))
    good = with_rig(good, joints=joints, rest_matrices=rest, skin_joints=skin_joints, skin_weights=skin_weights)
    good = replace(good, pose_matrices=np.concatenate([good.pose_matrices, still], axis=1))
    good = replace(good, partitions=make_partitions(good.rig))
    assert "20 of 240 vertices never move, of the partition 'no bone'" in warned(good)["still-vertices"]
