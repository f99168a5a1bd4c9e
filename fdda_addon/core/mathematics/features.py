# SPDX-License-Identifier: GPL-3.0-or-later
"""Joint features: transforms of joints relative to their reference joints and to the rest pose, inputs of networks."""

import numpy as np

from ..rig import Rig

FEATURES_PER_JOINT = 12
FLOAT32_ROUNDING_RATIO = 2.0**-21
"""Largest rounding error of float32, a few units in the last place, as a ratio of the largest coordinate."""
MIN_FEATURE_SPREAD = 5e-5
"""A feature is constant if its standard deviation over the training poses is smaller: no unit, or part of the
character's size for a length. Features that vary less express rounding in imported animation, and standardization
amplifies it."""


def joint_features(pose_matrices: np.ndarray, rest_matrices: np.ndarray, references: np.ndarray) -> np.ndarray:
    """Compute the transform of each joint relative to its reference joint (`references`) and to the rest pose.

    F_j = (B_r^-1 B_j)^-1 P_r^-1 P_j for joint j with reference joint r, rest matrices B and pose matrices P.

    F_j is the identity in the rest pose. Joints without a reference joint are relative to mesh-object space.

    Args:
        pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
        rest_matrices: (J, 4, 4), mesh-object space, mesh units.
        references: (J,) index of each reference joint; -1 for mesh-object space.

    Returns:
        (N, J, 12) float32: the upper three rows of F_j, row by row; rotations without unit, translations in mesh units.
    """
    pose = pose_matrices.astype(np.float64)
    rest = rest_matrices.astype(np.float64)
    relative = np.linalg.inv(_relative_to(references, rest[None])) @ _relative_to(references, pose)
    return relative[:, :, :3, :].reshape(*relative.shape[:2], FEATURES_PER_JOINT).astype(np.float32)


def _relative_to(references: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Convert (N, J, 4, 4) matrices from mesh-object space to the spaces of reference joints."""
    relative = matrices.copy()
    joints = np.flatnonzero(references >= 0)
    relative[:, joints] = np.linalg.inv(matrices[:, references[joints]]) @ matrices[:, joints]
    return relative


def float32_rounding(pose_matrices: np.ndarray) -> float:
    """Return the largest motion that rounding may give a joint at rest in (N, J, 4, 4) pose matrices, mesh units."""
    return FLOAT32_ROUNDING_RATIO * float(np.abs(pose_matrices[..., :3, 3]).max(initial=0))


def joint_features_in_metres(pose_matrices: np.ndarray, rig: Rig) -> np.ndarray:
    """Compute `joint_features` with translations in meters.

    A translation that differs between the poses by no more than `float32_rounding` is set to its mean.

    Returns:
        (N, J, 12) float32.
    """
    features = joint_features(pose_matrices, rig.rest_matrices, rig.references)
    translations = features[:, :, 3::4]
    is_constant = np.ptp(translations, axis=0) <= float32_rounding(pose_matrices)
    features[:, :, 3::4] = rig.metres_per_unit * np.where(is_constant, translations.mean(axis=0), translations)
    return features
