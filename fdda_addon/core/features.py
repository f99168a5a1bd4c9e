# SPDX-License-Identifier: GPL-3.0-or-later
"""What a network sees of a pose: the transforms of joints relative to parent and rest pose."""

import numpy as np

FEATURES_PER_JOINT = 12


def joint_features(pose_matrices: np.ndarray, rest_matrices: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Transform of each joint relative to its parent and to the rest pose, F_j = (B_p^-1 B_j)^-1 P_p^-1 P_j.

    The identity in the rest pose. The parent of a root is mesh-object space itself.

    Args:
        pose_matrices: (N, J, 4, 4), mesh-object space, metres.
        rest_matrices: (J, 4, 4), mesh-object space, metres.
        parents: (J,) parent index, -1 for a root; every parent before its children.

    Returns:
        (N, J, 12) float32: the upper three rows of F_j, row by row; rotations without unit, translations in metres.
    """
    return relative_features(pose_matrices, rest_matrices, parents, np.arange(len(parents)))


def relative_features(
    pose_matrices: np.ndarray, rest_matrices: np.ndarray, references: np.ndarray, joints: np.ndarray
) -> np.ndarray:
    """Transform of joints relative to other joints and to the rest pose, F = (B_r^-1 B_j)^-1 P_r^-1 P_j.

    Args:
        pose_matrices, rest_matrices: as for `joint_features`.
        references: (R,) index of the joint that each feature is relative to, -1 for mesh-object space.
        joints: (R,) index of the joint itself.

    Returns:
        (N, R, 12) float32, as `joint_features`.
    """

    def relative(matrices: np.ndarray) -> np.ndarray:
        inverse = np.linalg.inv(matrices)[:, references]
        inverse[:, references < 0] = np.eye(4)
        return inverse @ matrices[:, joints]

    rest = np.linalg.inv(relative(rest_matrices[None].astype(np.float64)))
    features = rest @ relative(pose_matrices.astype(np.float64))
    return features[:, :, :3, :].reshape(*features.shape[:2], FEATURES_PER_JOINT).astype(np.float32)


def relative_to_parent(matrices: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """(N, J, 4, 4) matrices in mesh-object space to matrices relative to the parent joint; roots stay as they are."""
    relative = matrices.copy()
    children = np.flatnonzero(parents >= 0)
    relative[:, children] = np.linalg.inv(matrices[:, parents[children]]) @ matrices[:, children]
    return relative
