# SPDX-License-Identifier: GPL-3.0-or-later
"""Half-rotation features: regressors for rigs that preserve volume, in addition to the skin matrices.

Such a rig blends rotations: a point halfway between a joint and its reference joint rotates by half the angle. No
linear combination of the two matrices does that. A half-rotation matrix is approximately proportional to the sine of
half the angle, and needs no square root. Blending of rotations: Kavan and others, Geometric Skinning with Approximate
Dual Quaternion Blending, 2008.
"""

import numpy as np

from fdda_addon.core.mathematics.features import joint_features
from fdda_addon.core.mathematics.skinning import skin_matrices
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import Rig

from .joint_fit import joint_regression

MIN_DIVISOR = 1.0
"""Lower bound of 3 + tr R, which is at least 2 for a rotation."""
MAX_POSES, MAX_VERTICES_PER_PARTITION = 800, 64
"""Maximum numbers of training poses and vertices on which the benefit is measured."""
MAX_ERROR_RATIO = 0.7
"""Half-rotation features are used when the squared residual is below this part of the one without them."""


def half_rotation_matrices(pose_matrices: np.ndarray, rig: Rig) -> np.ndarray:
    """Compute the half-rotation matrices V_j = Q_j A_j B_j^-1, with A_j = (R_j - R_j^T) / (3 + tr R_j).

    Q_j = P_r B_r^-1 B_j is the joint as its reference joint r carries it along. R_j is the rotation and scale of the
    joint relative to Q_j, the upper left of F_j in `core.mathematics.features`. Where R_j rotates by an angle a, A_j is
    sin a / (2 + cos a) [axis]x: within three hundredths of 0.687 sin (a/2) up to 120 degrees, and 0 at 0 and at 180.

    Args:
        pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.

    Returns:
        (N, J, 3, 3) float64, no unit; zero for joints without a reference joint.
    """
    references, joint_count = rig.references, len(rig.joints)
    rotations = joint_features(pose_matrices, rig.rest_matrices, references).reshape(-1, joint_count, 3, 4)[..., :3]
    rotations = rotations.astype(np.float64)
    divisors = np.maximum(3 + np.trace(rotations, axis1=2, axis2=3), MIN_DIVISOR)
    rotations = (rotations - rotations.swapaxes(2, 3)) / divisors[..., None, None]
    rest_rotations = rig.rest_matrices[:, :3, :3].astype(np.float64)
    reference_skin = skin_matrices(pose_matrices, rig.rest_matrices)[:, np.maximum(references, 0), :3, :3]
    matrices = reference_skin @ (rest_rotations @ rotations @ np.linalg.inv(rest_rotations))
    return np.where((references < 0)[:, None, None], 0, matrices)


def regression_matrices(pose_matrices: np.ndarray, rig: Rig, use_half_rotations: bool) -> np.ndarray:
    """Compute the matrices that residuals are regressed on.

    Args:
        pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
        use_half_rotations: whether to append half-rotation matrices.

    Returns:
        (N, J, 3, 4) float32 skin matrices, mesh units, or (N, 2 J, 3, 4), followed by half-rotation matrices with zero
        translation.
    """
    skin = skin_matrices(pose_matrices, rig.rest_matrices)[:, :, :3]
    if not use_half_rotations:
        return skin
    half_rotations = np.pad(half_rotation_matrices(pose_matrices, rig), ((0, 0), (0, 0), (0, 0), (0, 1)))
    return np.concatenate([skin, half_rotations.astype(np.float32)], axis=1)


def half_rotations_help(recording: SkinnedRecording, training: np.ndarray) -> bool:
    """Return whether half-rotation features lower the error enough to justify their nodes in the graph.

    Args:
        training: (n,) indices of the training poses. Half of the evaluated poses are fitted, the others are measured.
    """
    rig = recording.rig
    poses = training[:: -(-len(training) // MAX_POSES)]
    fitted_poses, measured_poses = np.arange(0, len(poses), 2), np.arange(1, len(poses), 2)
    pose_matrices = np.array(recording.pose_matrices[poses])
    candidates = [regression_matrices(pose_matrices, rig, use_half_rotations) for use_half_rotations in (False, True)]
    errors = np.zeros(2)
    for partition in recording.partitions:
        vertices = partition.vertices[:: -(-len(partition.vertices) // MAX_VERTICES_PER_PARTITION)]
        residuals = recording.compute_partition_residuals(partition, poses, vertices)
        for index, matrices in enumerate(candidates):
            _, remaining = joint_regression(rig, partition, matrices).fit(residuals, fitted_poses)
            mean_square = float((remaining[measured_poses].astype(np.float64) ** 2).mean())
            errors[index] += len(partition.vertices) * mean_square
    return bool(errors[1] < MAX_ERROR_RATIO * errors[0])
