# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the action `arm_drive`: reach, flex, fist, spread, and twenty frames outside of the range of motion."""

import math

import bpy

from ..scene.compatibility import animation_curves
from .joints import ACTION_NAME, FINGERS, JOINTS

LAST_FRAME = 250
# From this frame on, the pose is outside the range of motion.
FIRST_FRAME_BEYOND_RANGE = 231

Pose = dict[str, tuple[float, float, float]]
"""Local Euler angles in degrees, by joint."""


def _hand_pose(
    curl: float, spread: float = 0.0, cup: float = 0.0, thumb: tuple[float, float, float] = (0, 0, 0)
) -> Pose:
    """Return a pose of the hand.

    Args:
        curl: bending of the fingers, 0 (straight) to 1 (fist).
        spread: sideways angle of the outer fingers, degrees.
        cup: bending of the palm across the hand, degrees.
        thumb: bending and sideways angle of the metacarpal, and bending of the last joint, degrees.
    """
    pose: Pose = {}
    for finger_index, name in enumerate(FINGERS):
        sideways_angle = spread * (1.0, 0.25, -0.45, -1.0)[finger_index]
        palm_angle = cup * (0.1, 0.2, 0.6, 1.0)[finger_index]
        pose[f"{name}_0"] = (palm_angle, 0.0, sideways_angle * 0.15)
        pose[f"{name}_1"] = (curl * (84 + finger_index), 0.0, sideways_angle)
        pose[f"{name}_2"] = (max(curl, 0.0) * 98, 0.0, 0.0)
        pose[f"{name}_3"] = (max(curl, 0.0) * 70, 0.0, 0.0)
    pose["thumb_0"] = (thumb[0], 0.0, thumb[1])
    pose["thumb_1"] = (thumb[2] * 0.6, 0.0, 0.0)
    pose["thumb_2"] = (thumb[2], 0.0, 0.0)
    return pose


def _arm_pose(shoulder=(0.0, 0.0, 0.0), elbow=0.0, wrist=(0.0, 0.0)) -> Pose:
    return {"shoulder": shoulder, "elbow": (elbow, 0.0, 0.0), "wrist": (wrist[0], 0.0, wrist[1])}


def _pose_beyond_range(amount: float) -> Pose:
    """Return a pose outside of the range of motion; at an amount of 1, metacarpals are at 2.5 times their range."""
    pose = _arm_pose((70, 20, 30), 141 + 19 * amount, (60, -20)) | _hand_pose(0.5 + 0.4 * amount, 10, 0, (10, 10, 40))
    pose["elbow"] = (141 + 19 * amount, 4 + 30 * amount, -4 - 40 * amount)
    for i, name in enumerate(FINGERS):
        sign = 1 if i % 2 else -1
        pose[f"{name}_0"] = ((21 + 29 * amount) * sign, 8 * amount * sign, (5 + 20 * amount) * -sign)
    return pose


POSES_BY_FRAME: dict[int, Pose] = {
    1: _arm_pose() | _hand_pose(0),
    # Reach: move back, then to the front and up, while the hand opens.
    18: _arm_pose((-20, 10, -15), 55, (-20, 5)) | _hand_pose(0.25, 0, 4, (5, 0, 15)),
    36: _arm_pose((55, -15, 25), 25, (-35, -10)) | _hand_pose(0.05, 7, 0, (-10, 8, 0)),
    52: _arm_pose((70, -25, 45), 5, (10, 8)) | _hand_pose(0.15, 4, 3, (0, 4, 10)),
    # Flex: bend the elbow completely, twice.
    76: _arm_pose((10, 15, 25), 140, (35, 0)) | _hand_pose(0.70, 0, 8, (15, 8, 40)),
    92: _arm_pose((0, 25, 10), 60, (-10, -12)) | _hand_pose(0.45, 0, 4, (10, 0, 20)),
    110: _arm_pose((-15, 40, 35), 136, (50, 12)) | _hand_pose(0.85, 0, 10, (22, 12, 60)),
    # Fist: close the hand, rotate it about the wrist, and open it.
    132: _arm_pose((15, 0, 0), 70, (-30, 0)) | _hand_pose(1.0, 0, 12, (24, 15, 68)),
    146: _arm_pose((20, -30, 10), 75, (45, 15)) | _hand_pose(1.0, 0, 12, (24, 15, 68)),
    158: _arm_pose((20, -20, 0), 80, (0, -25)) | _hand_pose(1.0, 0, 10, (22, 12, 60)),
    172: _arm_pose((10, 0, -10), 60, (-20, 0)) | _hand_pose(0.35, 3, 4, (0, 5, 10)),
    # Spread: fan and stretch the fingers, and bend the metacarpals against each other.
    190: _arm_pose((-10, -20, -20), 30, (-55, 10)) | _hand_pose(-0.08, 15, -6, (-18, 22, -8)),
    204: _arm_pose((0, 20, -35), 45, (20, -25)) | _hand_pose(-0.05, 14, 14, (-10, 18, 0)),
    216: _arm_pose((30, 10, 0), 90, (-10, 0)) | _hand_pose(0.15, -5, 4, (5, 0, 20)),
    230: _arm_pose((70, 20, 30), 139, (60, -20)) | _hand_pose(0.5, 10, 0, (10, 10, 40)),
    FIRST_FRAME_BEYOND_RANGE: _pose_beyond_range(0.0),
    240: _pose_beyond_range(1.0),
    LAST_FRAME: _pose_beyond_range(0.6),
}


def assign_drive_action(armature_object: bpy.types.Object):
    """Create the action and assign it to an armature object, set the scene's frame range, and show frame 1."""
    action = bpy.data.actions.new(ACTION_NAME)
    armature_object.animation_data_create().action = action
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, LAST_FRAME
    bones = armature_object.pose.bones
    for frame, pose in POSES_BY_FRAME.items():
        for joint in JOINTS:
            bone = bones[joint.name]
            bone.rotation_euler = [math.radians(angle) for angle in pose[joint.name]]
            bone.keyframe_insert("rotation_euler", frame=frame, group=joint.name)
    # Whatever the preferences say, curves are smooth and do not overshoot.
    for curve in animation_curves(action):
        for point in curve.keyframe_points:
            point.interpolation = "BEZIER"
            point.handle_left_type = point.handle_right_type = "AUTO_CLAMPED"
        curve.update()
    scene.frame_set(1)
