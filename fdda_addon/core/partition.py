# SPDX-License-Identifier: GPL-3.0-or-later
"""Partitions: the vertices that share a main joint, and the joints that move their residuals."""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .defaults import MIN_PARTITION_VERTICES
from .rig import Rig

INFLUENCE_TOLERANCE = 1e-4
"""A joint influences a partition when it changes a local residual by more than this ratio of the rig's size."""
GOLDEN_RATIO = 0.618034


@dataclass(frozen=True)
class Partition:
    """The vertices that follow one main joint.

    Attributes:
        joint: index of the main joint.
        influencing: indices of the joints that move the local residuals, ascending; may be empty.
        vertices: (Vp,) int32 indices into the mesh, ascending.
        controls: indices of the controls that move the local residuals, ascending.
        merged: other main joints, ascending, whose small partitions were merged into this one.
    """

    joint: int
    influencing: tuple[int, ...]
    vertices: np.ndarray
    controls: tuple[int, ...] = ()
    merged: tuple[int, ...] = ()


def main_joints(skin_joints: np.ndarray, skin_weights: np.ndarray) -> np.ndarray:
    """Find the joint with the largest weight of each vertex, the first on a tie (paper, section 3.1).

    Args:
        skin_joints: (V, I) int32. skin_weights: (V, I) float32.

    Returns:
        (V,) int32 joint indices.
    """
    slots = np.argmax(skin_weights, axis=1)
    return np.take_along_axis(skin_joints, slots[:, None], axis=1)[:, 0].astype(np.int32)


def make_partitions(
    rig: Rig,
    influencing: dict[int, tuple[int, ...]] | None = None,
    controls: dict[int, tuple[int, ...]] | None = None,
    merged: dict[int, int] | None = None,
    reassigned: dict[int, Sequence[int]] | None = None,
) -> tuple[Partition, ...]:
    """Partition the mesh by main joint, in ascending order of the joints.

    Args:
        rig: the rig.
        influencing: influencing joints by main joint; none for all partitions when left out.
        controls: influencing controls by main joint; none for all partitions when left out.
        merged: by main joint of a merged partition, the main joint of the partition that takes its vertices.
        reassigned: by main joint, vertices with another main joint that belong to its partition.
    """
    main = main_joints(rig.skin_joints, rig.skin_weights)
    influencing, controls, merged = influencing or {}, controls or {}, merged or {}
    merged_joints: dict[int, list[int]] = {}
    for joint, other in sorted(merged.items()):
        main[main == joint] = other
        merged_joints.setdefault(other, []).append(joint)
    for joint, vertices in (reassigned or {}).items():
        main[list(vertices)] = joint
    return tuple(
        Partition(
            joint,
            tuple(influencing.get(joint, ())),
            np.flatnonzero(main == joint).astype(np.int32),
            tuple(controls.get(joint, ())),
            tuple(merged_joints.get(joint, ())),
        )
        for joint in np.unique(main).tolist()
    )


def make_merged_partitions(rig: Rig, min_vertices: int = MIN_PARTITION_VERTICES) -> tuple[Partition, ...]:
    """Partition the mesh by main joint, and merge small partitions as in `small_partition_merges`."""
    return make_partitions(rig, merged=small_partition_merges(rig, min_vertices))


def small_partition_merges(rig: Rig, min_vertices: int = MIN_PARTITION_VERTICES) -> dict[int, int]:
    """Choose the partitions into which small partitions are merged.

    The smallest partition is merged first, into the partition whose joint has the most weight on its vertices, else
    into the one of the nearest ancestor or descendant. A partition without either stays, and so does the last one.

    Args:
        rig: the rig.
        min_vertices: partitions with fewer vertices are small; 0 merges none.

    Returns:
        By main joint of a merged partition, the main joint of the partition that takes its vertices.
    """
    main = main_joints(rig.skin_joints, rig.skin_weights)
    weights: dict[int, np.ndarray] = {}
    for joint in np.unique(main).tolist():
        is_in = main == joint
        weights[joint] = np.bincount(
            rig.skin_joints[is_in].ravel(), rig.skin_weights[is_in].ravel(), minlength=len(rig.joints)
        )
    counts = dict(zip(*(values.tolist() for values in np.unique(main, return_counts=True)), strict=True))
    merged: dict[int, int] = {}
    stays: set[int] = set()
    while small := [joint for joint in counts if counts[joint] < min_vertices and joint not in stays]:
        joint = min(small, key=lambda j: (counts[j], j))
        other = _merge_target(rig, joint, weights)
        if other is None:
            stays.add(joint)
            continue
        counts[other] += counts.pop(joint)
        weights[other] += weights.pop(joint)
        stays.discard(other)
        merged = {j: other if into == joint else into for j, into in merged.items()} | {joint: other}
    return merged


def _merge_target(rig: Rig, joint: int, weights: dict[int, np.ndarray]) -> int | None:
    """Return the main joint of the partition that takes a small one; `weights` has the joints with a partition."""
    others = [other for other in weights if other != joint]
    heaviest = max(others, key=lambda other: weights[joint][other], default=None)
    if heaviest is None or weights[joint][heaviest] > 0:
        return heaviest
    generations = {other: _generations(rig, other, joint) or _generations(rig, joint, other) for other in others}
    return min((other for other in others if generations[other]), key=lambda other: generations[other], default=None)


def _generations(rig: Rig, ancestor: int, joint: int) -> int:
    """Count the generations from an ancestor down to a joint; 0 where it is no ancestor."""
    count = 0
    while joint >= 0 and joint != ancestor:
        joint, count = rig.joints[joint].parent, count + 1
    return count if joint >= 0 else 0


def assume_nearby_influences(rig: Rig, partitions: tuple[Partition, ...], sags: bool = True) -> tuple[Partition, ...]:
    """Give partitions the joints that are likely to influence them, where joints cannot be moved to detect it.

    These are the main joint, the joints with a weight on a vertex of the partition or on a vertex that shares a face
    with it, their parents, and every control. A surface that sags depends on the direction of gravity, so all
    ancestors are included. Otherwise a common root is left out, because it moves the partition as a whole.

    Args:
        rig: the rig.
        partitions: of the rig; their influences are ignored.
        sags: the surface may depend on the direction of gravity.
    """
    has_weight = np.zeros((rig.vertex_count, len(rig.joints)), bool)
    rows = np.repeat(np.arange(rig.vertex_count), rig.skin_joints.shape[1])
    used = rig.skin_weights.ravel() > 0
    has_weight[rows[used], rig.skin_joints.ravel()[used]] = True
    face_of_corner = np.repeat(
        np.arange(len(rig.face_starts)), np.diff(np.append(rig.face_starts, len(rig.face_vertices)))
    )
    joints = {}
    for partition in partitions:
        is_near = np.zeros(rig.vertex_count, bool)
        is_near[partition.vertices] = True
        touched = np.unique(face_of_corner[is_near[rig.face_vertices]])
        is_near[rig.face_vertices[np.isin(face_of_corner, touched)]] = True
        influences = {partition.joint, *np.flatnonzero(has_weight[is_near].any(axis=0)).tolist()}
        influences |= {rig.joints[joint].parent for joint in influences if rig.joints[joint].parent >= 0}
        if sags:
            ancestor = rig.joints[partition.joint].parent
            while ancestor >= 0:
                influences.add(ancestor)
                ancestor = rig.joints[ancestor].parent
        elif len({_root_of(rig, joint) for joint in influences}) == 1:
            influences -= {_root_of(rig, partition.joint)}
        joints[partition.joint] = tuple(sorted(influences))
    controls = {partition.joint: tuple(range(len(rig.controls))) for partition in partitions}
    merged = {joint: partition.joint for partition in partitions for joint in partition.merged}
    return make_partitions(rig, joints, controls, merged)


def _root_of(rig: Rig, joint: int) -> int:
    while rig.joints[joint].parent >= 0:
        joint = rig.joints[joint].parent
    return joint


def max_residual_changes(partitions: tuple[Partition, ...], moved: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Compute the largest change of a local residual in each partition.

    Args:
        partitions: P partitions.
        moved: (N, V, 3) float32 local residuals, axes of the main joint, mesh units.
        base: local residuals to compare with, of N poses or of one.

    Returns:
        (N, P) float64, mesh units.
    """
    distances = np.linalg.norm(moved - base, axis=2)
    return np.stack([distances[:, p.vertices].max(axis=1, initial=0) for p in partitions], axis=1).astype(np.float64)


def partition_colors(partitions: tuple[Partition, ...], vertex_count: int) -> np.ndarray:
    """Choose a color for each partition; returns (V, 3) float32 sRGB by vertex, 0 to 1."""
    colors = np.zeros((vertex_count, 3), np.float32)
    for index, partition in enumerate(partitions):
        # Steps of the golden ratio keep neighboring hues apart, whatever the count.
        value = 0.95 if index % 2 else 0.75
        colors[partition.vertices] = colorsys.hsv_to_rgb(index * GOLDEN_RATIO % 1, 0.62, value)
    return colors
