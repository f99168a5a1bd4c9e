# SPDX-License-Identifier: GPL-3.0-or-later
"""Repairs poses in which joint matrices are not finite."""

import numpy as np

from .model_info import ModelInfo


def repair_pose(pose_matrices: np.ndarray, info: ModelInfo) -> tuple[np.ndarray, str]:
    """Replace joint matrices that are not finite: such a joint moves with its parent.

    Args:
        pose_matrices: (J, 4, 4) float32, mesh-object space. At least one is not finite.
        info: metadata of the model, with the joints and their rest matrices.

    Returns:
        (J, 4, 4) float32, mesh-object space; and the name of the first joint that was replaced.
    """
    rest_matrices = info.rest_matrices.astype(np.float64)
    skin_matrices = pose_matrices @ np.linalg.inv(rest_matrices)
    is_finite = np.isfinite(skin_matrices).all(axis=(1, 2))
    for joint in np.flatnonzero(~is_finite):
        parent = info.joints[joint].parent  # Already repaired, because parents come before their children.
        skin_matrices[joint] = skin_matrices[parent] if parent >= 0 else np.eye(4)
    repaired = pose_matrices.copy()
    repaired[~is_finite] = (skin_matrices @ rest_matrices)[~is_finite]
    return repaired, info.joints[int(np.argmin(is_finite))].name
