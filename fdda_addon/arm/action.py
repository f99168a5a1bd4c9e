# SPDX-License-Identifier: GPL-3.0-or-later
"""The action `arm_drive`: reach, flex, fist, spread, and twenty frames outside of the range of motion."""

import math
from contextlib import contextmanager

import bpy

from .joints import ACTION, FINGERS, JOINTS

FRAMES = 250
# From here on the pose is outside the range of motion.
BEYOND_START_FRAME = 231

Pose = dict[str, tuple[float, float, float]]


def _hand(curl: float, across: float = 0.0, cup: float = 0.0, thumb: tuple[float, float, float] = (0, 0, 0)) -> Pose:
    """Fingers curled by `curl` (0..1), fanned by `across` degrees, palm cupped by `cup` degrees."""
    pose: Pose = {}
    for i, name in enumerate(FINGERS):
        fan = across * (1.0, 0.25, -0.45, -1.0)[i]
        fold = cup * (0.1, 0.2, 0.6, 1.0)[i]
        pose[f"{name}_0"] = (fold, 0.0, fan * 0.15)
        pose[f"{name}_1"] = (curl * (84 + i), 0.0, fan)
        pose[f"{name}_2"] = (max(curl, 0.0) * 98, 0.0, 0.0)
        pose[f"{name}_3"] = (max(curl, 0.0) * 70, 0.0, 0.0)
    pose["thumb_0"] = (thumb[0], 0.0, thumb[1])
    pose["thumb_1"] = (thumb[2] * 0.6, 0.0, 0.0)
    pose["thumb_2"] = (thumb[2], 0.0, 0.0)
    return pose


def _arm(shoulder=(0.0, 0.0, 0.0), elbow=0.0, wrist=(0.0, 0.0)) -> Pose:
    return {"shoulder": shoulder, "elbow": (elbow, 0.0, 0.0), "wrist": (wrist[0], 0.0, wrist[1])}


def _beyond_range(amount: float) -> Pose:
    """Return a pose outside of the range: at `amount` 1 off the elbow's axis, metacarpals at 2.5 times their range."""
    pose = _arm((70, 20, 30), 141 + 19 * amount, (60, -20)) | _hand(0.5 + 0.4 * amount, 10, 0, (10, 10, 40))
    pose["elbow"] = (141 + 19 * amount, 4 + 30 * amount, -4 - 40 * amount)
    for i, name in enumerate(FINGERS):
        side = 1 if i % 2 else -1
        pose[f"{name}_0"] = ((21 + 29 * amount) * side, 8 * amount * side, (5 + 20 * amount) * -side)
    return pose


# frame: local Euler angles in degrees
KEYS: dict[int, Pose] = {
    1: _arm() | _hand(0),
    # Reach: back, then out to the front and up, the hand opening.
    18: _arm((-20, 10, -15), 55, (-20, 5)) | _hand(0.25, 0, 4, (5, 0, 15)),
    36: _arm((55, -15, 25), 25, (-35, -10)) | _hand(0.05, 7, 0, (-10, 8, 0)),
    52: _arm((70, -25, 45), 5, (10, 8)) | _hand(0.15, 4, 3, (0, 4, 10)),
    # Flex: the elbow all the way, twice.
    76: _arm((10, 15, 25), 140, (35, 0)) | _hand(0.70, 0, 8, (15, 8, 40)),
    92: _arm((0, 25, 10), 60, (-10, -12)) | _hand(0.45, 0, 4, (10, 0, 20)),
    110: _arm((-15, 40, 35), 136, (50, 12)) | _hand(0.85, 0, 10, (22, 12, 60)),
    # Fist: closed, turned about the wrist, and let go.
    132: _arm((15, 0, 0), 70, (-30, 0)) | _hand(1.0, 0, 12, (24, 15, 68)),
    146: _arm((20, -30, 10), 75, (45, 15)) | _hand(1.0, 0, 12, (24, 15, 68)),
    158: _arm((20, -20, 0), 80, (0, -25)) | _hand(1.0, 0, 10, (22, 12, 60)),
    172: _arm((10, 0, -10), 60, (-20, 0)) | _hand(0.35, 3, 4, (0, 5, 10)),
    # Spread: fingers fanned and stretched, the metacarpals one against the other.
    190: _arm((-10, -20, -20), 30, (-55, 10)) | _hand(-0.08, 15, -6, (-18, 22, -8)),
    204: _arm((0, 20, -35), 45, (20, -25)) | _hand(-0.05, 14, 14, (-10, 18, 0)),
    216: _arm((30, 10, 0), 90, (-10, 0)) | _hand(0.15, -5, 4, (5, 0, 20)),
    230: _arm((70, 20, 30), 139, (60, -20)) | _hand(0.5, 10, 0, (10, 10, 40)),
    BEYOND_START_FRAME: _beyond_range(0.0),
    240: _beyond_range(1.0),
    FRAMES: _beyond_range(0.6),
}


@contextmanager
def _add_bezier_keyframes():
    """Insert Bezier keys with clamped handles, independent of preferences, so that curves stay between their keys."""
    edit = bpy.context.preferences.edit
    names = ("keyframe_new_interpolation_type", "keyframe_new_handle_type")
    before = [getattr(edit, name) for name in names]
    edit.keyframe_new_interpolation_type, edit.keyframe_new_handle_type = "BEZIER", "AUTO_CLAMPED"
    try:
        yield
    finally:
        for name, value in zip(names, before, strict=True):
            setattr(edit, name, value)


def assign_drive_action(rig: bpy.types.Object):
    """Assign the action to `rig` and its frame range to the current scene, and show frame 1."""
    action = bpy.data.actions.new(ACTION)
    rig.animation_data_create().action = action
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, FRAMES
    bones = rig.pose.bones
    with _add_bezier_keyframes():
        for frame, pose in KEYS.items():
            for joint in JOINTS:
                bone = bones[joint.name]
                bone.rotation_euler = [math.radians(angle) for angle in pose[joint.name]]
                bone.keyframe_insert("rotation_euler", frame=frame, group=joint.name)
    scene.frame_set(1)
