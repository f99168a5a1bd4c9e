# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the residuals of a partition from a recording."""

import numpy as np

from fdda_addon.core.partition import Partition
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.skinning import skin_matrices


def residuals_of(recording: Recording, partition: Partition, poses: np.ndarray | None = None) -> np.ndarray:
    """Read the local residuals of a partition's vertices in the space of its main joint.

    Args:
        recording: recording with the residuals.
        partition: partition to read. Residuals of vertices that have another main joint in the recording are converted.
        poses: (n,) indices; None for all.

    Returns:
        (n, Vp, 3) float32, mesh units.
    """
    vertices, rest_matrices = partition.vertices, recording.rig.rest_matrices
    rows = slice(None) if poses is None else poses
    residuals = recording.residuals[:, vertices] if poses is None else recording.residuals[np.ix_(poses, vertices)]
    main_joints = np.empty(recording.rig.vertex_count, np.int64)
    for recorded in recording.partitions:
        main_joints[recorded.vertices] = recorded.joint
    for joint in np.setdiff1d(main_joints[vertices], partition.joint).tolist():
        pair = [partition.joint, joint]
        skin = skin_matrices(recording.pose_matrices[rows][:, pair], rest_matrices[pair])[:, :, :3, :3]
        relative = np.linalg.inv(skin[:, 0].astype(np.float64)) @ skin[:, 1]
        is_converted = main_joints[vertices] == joint
        converted = residuals[:, is_converted] @ relative.astype(np.float32).transpose(0, 2, 1)
        residuals[:, is_converted] = converted
    return residuals
