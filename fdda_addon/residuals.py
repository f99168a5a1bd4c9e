# SPDX-License-Identifier: GPL-3.0-or-later
"""Local residuals of what a rig evaluates to, with a sentence where there are none."""

import numpy as np

from .core.errors import RigError
from .core.skinning import LinearLayer


def local_residuals(layer: LinearLayer, pose_matrices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """As `LinearLayer.local_residuals`.

    Raises:
        RigError: a joint is without extent in some pose.
    """
    try:
        return layer.local_residuals(pose_matrices, positions)
    except np.linalg.LinAlgError as error:
        flat = np.abs(np.linalg.det(pose_matrices[:, :, :3, :3].astype(np.float64))).min(axis=0)
        raise RigError(
            f"Bone '{layer.rig.joint_names[int(flat.argmin())]}' has a scale of zero in some pose; "
            "look for a constraint or driver that sets it."
        ) from error
