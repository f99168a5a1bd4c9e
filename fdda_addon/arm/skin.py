# SPDX-License-Identifier: GPL-3.0-or-later
"""Assigns each vertex of the arm to one bone, which has the skin weight 1."""

import numpy as np

from .joints import FINGERS, JOINT_INDEX, UPPER_ARM_LENGTH, WRIST_X, joint
from .quads import Grid


def _is_past_joint_plane(points: np.ndarray, name_before: str, name_after: str) -> np.ndarray:
    """Return which points are past the plane that bisects the angle of two bones at their common joint, (n,) bool."""
    bone_before, bone_after = joint(name_before), joint(name_after)
    axes = [np.array(bone.tail) - np.array(bone.head) for bone in (bone_before, bone_after)]
    normal = sum(axis / np.linalg.norm(axis) for axis in axes)
    return (points - np.array(bone_after.head)) @ normal > 0.0


def _distance_to_bone(points: np.ndarray, name: str, start: float = 0.0) -> np.ndarray:
    """Compute (n,) distances in meters to a bone, from the fraction `start` (0 to 1) of its length to its tail."""
    head, tail = np.array(joint(name).head), np.array(joint(name).tail)
    head = head + (tail - head) * start
    axis = tail - head
    fraction = np.clip((points - head) @ axis / (axis @ axis), 0.0, 1.0)
    return np.linalg.norm(points - head - fraction[:, None] * axis, axis=1)


def assign_joints(points: np.ndarray, grid: Grid) -> np.ndarray:
    """Return the (n,) int32 index into `JOINTS` of the bone of each vertex, given (n, 3) rest points in meters.

    Fingers are divided at the planes of their joints, and no vertex of a finger follows another finger. A vertex of the
    palm follows the metacarpal of its finger column, and a vertex of the ball of the thumb follows that of the thumb.
    """
    joint_indices = np.full(len(points), JOINT_INDEX["shoulder"], np.int32)
    joint_indices[points[:, 0] >= UPPER_ARM_LENGTH] = JOINT_INDEX["elbow"]
    in_hand = (points[:, 0] >= WRIST_X) | (grid.digit >= 0)
    joint_indices[in_hand] = JOINT_INDEX["wrist"]
    for finger_number, name in enumerate(FINGERS, start=1):
        is_in_chain = in_hand & np.where(
            grid.digit >= 0, grid.digit == finger_number, grid.finger_column == finger_number
        )
        for bone_index in range(4):
            name_before = "wrist" if bone_index == 0 else f"{name}_{bone_index - 1}"
            is_in_chain = is_in_chain & (
                _is_past_joint_plane(points, name_before, f"{name}_{bone_index}")
                | (bone_index < 2) & (grid.digit == finger_number)
            )
            joint_indices[is_in_chain] = JOINT_INDEX[f"{name}_{bone_index}"]
    is_thumb = grid.digit == 0
    # The ball of the thumb is nearer to the thumb's metacarpal than to other bones, and not behind its joint.
    is_thumb_ball = in_hand & (grid.digit < 0) & (grid.finger_column <= 2) & (joint_indices != JOINT_INDEX["index_1"])
    distance_to_fingers = np.minimum(_distance_to_bone(points, "index_0"), _distance_to_bone(points, "middle_0"))
    is_thumb_ball &= _is_past_joint_plane(points, "wrist", "thumb_0")
    is_thumb_ball &= _distance_to_bone(points, "thumb_0", 0.25) < 0.95 * np.minimum(
        distance_to_fingers, _distance_to_bone(points, "wrist") + 0.002
    )
    joint_indices[is_thumb | is_thumb_ball] = JOINT_INDEX["thumb_0"]
    # The web of the thumb follows the metacarpal of the thumb.
    is_thumb &= _distance_to_bone(points, "thumb_1") < _distance_to_bone(points, "index_0") - 0.003
    for bone_index in (1, 2):
        is_thumb = is_thumb & _is_past_joint_plane(points, f"thumb_{bone_index - 1}", f"thumb_{bone_index}")
        joint_indices[is_thumb] = JOINT_INDEX[f"thumb_{bone_index}"]
    return joint_indices
