# SPDX-License-Identifier: GPL-3.0-or-later
"""Skin weights of the arm: one bone per vertex, with weight 1.0."""

import numpy as np

from .joints import FINGERS, JOINT_INDEX, UPPER_ARM_LENGTH, WRIST_X, joint
from .quads import Grid


def _past_joint_plane(points: np.ndarray, before: str, after: str) -> np.ndarray:
    """Return which points are past the bisector plane of two bones at their common joint, (n,) bool."""
    first, second = joint(before), joint(after)
    axes = [np.array(bone.tail) - np.array(bone.head) for bone in (first, second)]
    normal = sum(axis / np.linalg.norm(axis) for axis in axes)
    return (points - np.array(second.head)) @ normal > 0.0


def _distance_to_bone(points: np.ndarray, name: str, start: float = 0.0) -> np.ndarray:
    """Compute (n,) distances in meters to a bone's segment without its first part `start` (0..1)."""
    head, tail = np.array(joint(name).head), np.array(joint(name).tail)
    head = head + (tail - head) * start
    axis = tail - head
    t = np.clip((points - head) @ axis / (axis @ axis), 0.0, 1.0)
    return np.linalg.norm(points - head - t[:, None] * axis, axis=1)


def main_joints(points: np.ndarray, grid: Grid) -> np.ndarray:
    """Return the (n,) int32 index into `JOINTS` of (n, 3) rest points, meters.

    Fingers are cut at their joints, by chain: no vertex of a finger follows another one. The palm goes to the
    metacarpals by column, the ball of the thumb to the thumb's.
    """
    result = np.full(len(points), JOINT_INDEX["shoulder"], np.int32)
    result[points[:, 0] >= UPPER_ARM_LENGTH] = JOINT_INDEX["elbow"]
    in_hand = (points[:, 0] >= WRIST_X) | (grid.digit >= 0)
    result[in_hand] = JOINT_INDEX["wrist"]
    for k, name in enumerate(FINGERS, start=1):
        chain = in_hand & np.where(grid.digit >= 0, grid.digit == k, grid.column == k)
        for i in range(4):
            before = "wrist" if i == 0 else f"{name}_{i - 1}"
            chain = chain & (_past_joint_plane(points, before, f"{name}_{i}") | (i < 2) & (grid.digit == k))
            result[chain] = JOINT_INDEX[f"{name}_{i}"]
    thumb = grid.digit == 0
    # The ball of the thumb: nearer to its metacarpal than to the others, and not behind the joint that it turns about.
    ball = in_hand & (grid.digit < 0) & (grid.column <= 2) & (result != JOINT_INDEX["index_1"])
    to_index = np.minimum(_distance_to_bone(points, "index_0"), _distance_to_bone(points, "middle_0"))
    ball &= _past_joint_plane(points, "wrist", "thumb_0")
    ball &= _distance_to_bone(points, "thumb_0", 0.25) < 0.95 * np.minimum(
        to_index, _distance_to_bone(points, "wrist") + 0.002
    )
    result[thumb | ball] = JOINT_INDEX["thumb_0"]
    # Its web stays with the metacarpal.
    thumb &= _distance_to_bone(points, "thumb_1") < _distance_to_bone(points, "index_0") - 0.003
    for i in (1, 2):
        thumb = thumb & _past_joint_plane(points, f"thumb_{i - 1}", f"thumb_{i}")
        result[thumb] = JOINT_INDEX[f"thumb_{i}"]
    return result
