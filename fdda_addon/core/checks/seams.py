# SPDX-License-Identifier: GPL-3.0-or-later
"""Detection of a mesh that is cut into pieces which come apart.

Importers of game formats split a vertex wherever its normal or UV differs, so that faces lie side by side without being
connected. Modifiers that smooth then move each piece alone. Its tangents depend on tiny differences, and the surface
jumps and opens in cracks, which no network can learn (docs/experiments.md, Characters that others made).
"""

import numpy as np

from ..partition import main_joints
from ..recording.reader import Recording
from ..rig import Rig
from .warning import RecordingWarning, format_length

POSITION_DIGITS = 5
"""Vertices that lie on each other have equal positions to this number of decimal digits of the rig's size."""
WEIGHT_DIGITS = 4
"""Skin weights are equal to this number of decimal digits."""
MIN_GAP_RATIO = 1e-3
"""Smallest gap between two vertices, as a ratio of the rig's size."""
MAX_TORN_RATIO = 0.01
"""Largest ratio of vertices that come apart without a warning."""
MAX_POSES = 50
"""Number of poses in which the gaps are measured."""


def check_seams(recording: Recording) -> list[RecordingWarning]:
    """Return the warning "open-seams" if vertices that lie on each other at rest come apart in the poses."""
    rig, pose_count = recording.rig, len(recording.residuals)
    vertices, groups = _coincident_vertices(rig)
    if len(vertices) <= MAX_TORN_RATIO * rig.vertex_count:
        return []
    counts, gaps = np.bincount(groups), np.zeros(len(vertices))
    for pose in np.unique(np.linspace(0, pose_count - 1, MAX_POSES).round().astype(np.int64)):
        residuals = np.array(recording.residuals[pose])[vertices].astype(np.float64)
        means = np.stack([np.bincount(groups, values) for values in residuals.T], axis=1) / counts[:, None]
        np.maximum(gaps, 2 * np.linalg.norm(residuals - means[groups], axis=1), out=gaps)
    torn_count = int((gaps > MIN_GAP_RATIO * rig.size).sum())
    if torn_count <= MAX_TORN_RATIO * rig.vertex_count:
        return []
    text = (
        f"{torn_count:,} of {rig.vertex_count:,} vertices lie on other vertices and come apart from them, by up to "
        f"{format_length(rig, float(gaps.max()))}: the mesh is cut there, smoothing moves each piece alone, and no "
        "network can learn that well; merge them (Edit Mode, Mesh > Merge > By Distance), and record again."
    )
    return [RecordingWarning("open-seams", text)]


def _coincident_vertices(rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Find vertices that lie on others which have the same skin weights.

    Returns:
        (n,) int64 indices of the vertices, and (n,) int64 index of the group of each, from 0.
    """
    keys = np.concatenate(
        [
            (rig.rest_positions / max(rig.size, np.finfo(np.float32).tiny)).round(POSITION_DIGITS),
            np.where(rig.skin_weights > 0, rig.skin_joints, -1),
            rig.skin_weights.round(WEIGHT_DIGITS),
            main_joints(rig.skin_joints, rig.skin_weights)[:, None],
        ],
        axis=1,
        dtype=np.float64,
    )
    # Adding zero turns -0 into 0.
    _, groups, counts = np.unique(keys + 0.0, axis=0, return_inverse=True, return_counts=True)
    groups = groups.ravel()
    vertices = np.flatnonzero(counts[groups] > 1)
    return vertices, np.unique(groups[vertices], return_inverse=True)[1].ravel()
