# SPDX-License-Identifier: GPL-3.0-or-later
"""Detection of a mesh that is cut into pieces which come apart.

Importers of game formats split a vertex wherever its normal or UV differs, so that faces lie side by side without being
connected. Modifiers that smooth then move each piece alone. Its tangents depend on tiny differences, and the surface
jumps and opens in cracks, which no network can learn (docs/characters.md, Characters that others made).
"""

import numpy as np

from ..mathematics.partition import main_joints
from ..mathematics.surface import adjacent_corners
from ..recording.skinned import SkinnedRecording
from ..rig import Rig
from .warning import RecordingWarning, format_length

POSITION_DIGITS = 5
"""Vertices that lie on each other have equal positions to this number of decimal digits of the rig's size."""
WEIGHT_DIGITS = 4
"""Skin weights are equal to this number of decimal digits."""
MIN_GAP_RATIO = 1e-3
"""Smallest change of a gap between two vertices, as a ratio of the rig's size."""
MAX_TORN_RATIO = 0.01
"""Largest ratio of vertices that come apart without a warning."""
MAX_POSES = 50
"""Number of poses in which the gaps are measured."""


def count_split_vertices(rig: Rig) -> int:
    """Count the vertices that lie on others along cuts of the mesh; 0 if these are few."""
    count = len(np.unique(_seam_pairs(rig)))
    return count if count > MAX_TORN_RATIO * rig.vertex_count else 0


def split_vertex_groups(rig: Rig) -> list[np.ndarray]:
    """Return the vertices along cuts of the mesh, those that lie on each other in one array."""
    vertices = np.unique(_seam_pairs(rig))
    groups = _coincident_groups(rig)[vertices]
    order = np.argsort(groups, kind="stable")
    return np.split(vertices[order], np.flatnonzero(np.diff(groups[order])) + 1) if len(vertices) else []


def check_seams(recording: SkinnedRecording) -> list[RecordingWarning]:
    """Return the warning "open-seams" if cuts open in evenly spaced poses; none if the faces of the rig are unknown.

    Gaps that are the same in all poses can be learned, so they do not count.
    """
    rig, poses = recording.rig, np.linspace(0, len(recording.rows) - 1, MAX_POSES).round().astype(np.int64)
    pairs = _seam_pairs(rig)
    if len(np.unique(pairs)) <= MAX_TORN_RATIO * rig.vertex_count:
        return []
    changes, gaps, first_gaps = np.zeros(len(pairs)), np.zeros(len(pairs)), None
    for pose_residuals in recording.iterate_residuals(np.unique(poses)):
        pose_gaps = pose_residuals[pairs[:, 0]].astype(np.float64) - pose_residuals[pairs[:, 1]]
        first_gaps = pose_gaps if first_gaps is None else first_gaps
        np.maximum(gaps, np.linalg.norm(pose_gaps, axis=1), out=gaps)
        np.maximum(changes, np.linalg.norm(pose_gaps - first_gaps, axis=1), out=changes)
    is_torn = changes > MIN_GAP_RATIO * rig.size
    torn_count = len(np.unique(pairs[is_torn]))
    if torn_count <= MAX_TORN_RATIO * rig.vertex_count:
        return []
    text = (
        f"{torn_count:,} of {rig.vertex_count:,} vertices lie on others along cuts of the mesh and come apart by up to "
        f"{format_length(rig, float(gaps[is_torn].max()))}: smoothing moves each piece alone, and no network can learn "
        "that well; unless they should open, as lids do, merge them (Edit Mode, Mesh > Merge > By Distance, with Sharp "
        "Edges on), and record again."
    )
    return [RecordingWarning("open-seams", text)]


def _seam_pairs(rig: Rig) -> np.ndarray:
    """Find the vertices of open edges, which belong to one face, that lie on other open edges.

    Returns:
        (n, 2) int64, pairs of vertices that lie on each other and have the same skin weights.
    """
    groups = _coincident_groups(rig) if len(rig.face_starts) else np.zeros(0, np.int64)
    if not (groups >= 0).any():
        return np.zeros((0, 2), np.int64)
    following = rig.face_vertices[adjacent_corners(rig.face_starts, rig.face_vertices)[1]]
    ends = np.sort(np.stack([rig.face_vertices, following], axis=1).astype(np.int64), axis=1)
    edges, face_counts = np.unique(ends @ (rig.vertex_count, 1), return_counts=True)
    edges = np.stack(np.divmod(edges, rig.vertex_count), axis=1)
    edges = edges[(face_counts == 1) & (groups[edges] >= 0).all(axis=1)]
    edges = np.take_along_axis(edges, np.argsort(groups[edges], axis=1), axis=1)
    places = groups[edges]
    order = np.lexsort(places.T)
    edges, places = edges[order], places[order]
    # Each edge is paired with the first edge in the same place.
    _, first_edges, place_of_edge = np.unique(places, axis=0, return_index=True, return_inverse=True)
    return np.stack([edges[first_edges[place_of_edge.ravel()]], edges], axis=2).reshape(-1, 2)


def _coincident_groups(rig: Rig) -> np.ndarray:
    """Group the vertices that lie on others of the same mesh which have the same skin weights.

    Returns:
        (V,) int64, index of the group of each vertex; -1 for a vertex that lies on no other.
    """
    positions = (rig.rest_positions / max(rig.size, np.finfo(np.float32).tiny)).round(POSITION_DIGITS)
    groups = np.full(rig.vertex_count, -1)
    # One number for each place is sorted much faster than rows. Different places rarely have the same number.
    places = positions.astype(np.float64) @ (1.0, np.sqrt(2.0), np.sqrt(3.0))
    order = np.argsort(places)
    is_next_equal = np.append(np.diff(places[order]) < 10.0**-POSITION_DIGITS * 1e-3, False)
    vertices = np.sort(order[is_next_equal | np.roll(is_next_equal, 1)])
    if len(vertices):
        joints, weights = rig.skin_joints[vertices], rig.skin_weights[vertices]
        order = np.argsort(np.where(weights > 0, joints, -1), axis=1)
        joints, weights = (np.take_along_axis(values, order, axis=1) for values in (joints, weights))
        main = main_joints(rig.skin_joints[vertices], rig.skin_weights[vertices])
        meshes = np.repeat(np.arange(len(rig.meshes)), [mesh.vertices for mesh in rig.meshes])[vertices]
        columns = (
            positions[vertices],
            meshes[:, None],
            np.where(weights > 0, joints, -1),
            weights.round(WEIGHT_DIGITS),
            main[:, None],
        )
        # Adding zero turns -0 into 0.
        rows = np.concatenate(columns, axis=1, dtype=np.float64) + 0.0
        _, indices, counts = np.unique(rows, axis=0, return_inverse=True, return_counts=True)
        indices = indices.ravel()
        groups[vertices] = np.where(counts[indices] > 1, indices, -1)
    return groups
