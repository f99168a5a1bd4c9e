# SPDX-License-Identifier: GPL-3.0-or-later
"""Partitions: the vertices that share a main joint, and the joints that move their residuals."""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .defaults import MIN_PARTITION_VERTICES
from .rig import Rig

INFLUENCE_TOLERANCE = 1e-4
"""A joint influences a partition when it moves a local residual by more than this part of the character's size."""
GOLDEN_RATIO = 0.618034


@dataclass(frozen=True)
class Partition:
    """The vertices that follow one main joint.

    Attributes:
        joint: index of the main joint.
        influencing: indices of the joints that move the local residuals, ascending; may be empty.
        vertices: (Vp,) int32 indices into the mesh, ascending.
        controls: indices of the controls that move the local residuals, ascending.
        merged: other main joints, ascending, whose vertices were too few for a partition and count to this one.
    """

    joint: int
    influencing: tuple[int, ...]
    vertices: np.ndarray
    controls: tuple[int, ...] = ()
    merged: tuple[int, ...] = ()


def main_joints(skin_joints: np.ndarray, skin_weights: np.ndarray) -> np.ndarray:
    """The joint of the largest weight of each vertex, the first on a tie (paper, section 3.1).

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
    taken: dict[int, Sequence[int]] | None = None,
) -> tuple[Partition, ...]:
    """Cut the mesh by main joint, in ascending order of the joints.

    Args:
        rig: the rig.
        influencing: influencing joints by main joint; none for all partitions when left out.
        controls: influencing controls by main joint; none for all partitions when left out.
        merged: main joints whose vertices count to the partition of another, and that other one.
        taken: by main joint the vertices of other partitions that count to its own.
    """
    main = main_joints(rig.skin_joints, rig.skin_weights)
    influencing, controls, merged = influencing or {}, controls or {}, merged or {}
    gone: dict[int, list[int]] = {}
    for joint, other in sorted(merged.items()):
        main[main == joint] = other
        gone.setdefault(other, []).append(joint)
    for joint, vertices in (taken or {}).items():
        main[list(vertices)] = joint
    return tuple(
        Partition(
            joint,
            tuple(influencing.get(joint, ())),
            np.flatnonzero(main == joint).astype(np.int32),
            tuple(controls.get(joint, ())),
            tuple(gone.get(joint, ())),
        )
        for joint in np.unique(main).tolist()
    )


def make_merged_partitions(rig: Rig, min_vertices: int = MIN_PARTITION_VERTICES) -> tuple[Partition, ...]:
    """Cut the mesh by main joint, and merge partitions of fewer vertices as in `small_partition_merges`."""
    return make_partitions(rig, merged=small_partition_merges(rig, min_vertices))


def small_partition_merges(rig: Rig, min_vertices: int = MIN_PARTITION_VERTICES) -> dict[int, int]:
    """Choose where the vertices of small partitions go.

    The smallest goes first: to the partition whose joint has the most weight on its vertices, else to that of the
    nearest ancestor or descendant. One with neither stays, and so does the last of all.

    Args:
        rig: the rig.
        min_vertices: partitions of fewer vertices are small; 0 merges none.

    Returns:
        For each main joint whose vertices go elsewhere the joint whose partition takes them, for `make_partitions`.
    """
    main = main_joints(rig.skin_joints, rig.skin_weights)
    weights: dict[int, np.ndarray] = {}
    for joint in np.unique(main).tolist():
        own = main == joint
        weights[joint] = np.bincount(
            rig.skin_joints[own].ravel(), rig.skin_weights[own].ravel(), minlength=len(rig.joints)
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
    """The joint whose partition takes the vertices of a small one; `weights` has the joints that have one."""
    others = [other for other in weights if other != joint]
    heaviest = max(others, key=lambda other: weights[joint][other], default=None)
    if heaviest is None or weights[joint][heaviest] > 0:
        return heaviest
    steps = {other: _steps_down(rig, other, joint) or _steps_down(rig, joint, other) for other in others}
    return min((other for other in others if steps[other]), key=lambda other: steps[other], default=None)


def _steps_down(rig: Rig, ancestor: int, joint: int) -> int:
    """How many generations a joint is below an ancestor; 0 when it is not."""
    steps = 0
    while joint >= 0 and joint != ancestor:
        joint, steps = rig.joints[joint].parent, steps + 1
    return steps if joint >= 0 else 0


def assume_nearby_influences(rig: Rig, partitions: tuple[Partition, ...], sags: bool = True) -> tuple[Partition, ...]:
    """Partitions with the joints that are likely to influence them, where none can be moved to see whether it does.

    These are the main joint, those that skin a vertex of the partition or one that shares a face with it, the parents
    of all of these, and every control. Where the surface sags, all joints above are among them, as it asks which way is
    down; where it does not, the one root of all of them is not, as it moves them as a whole.

    Args:
        rig: the rig.
        partitions: of the rig; their influences are left out.
        sags: the surface may depend on which way is down.
    """
    skins = np.zeros((rig.vertex_count, len(rig.joints)), bool)
    rows = np.repeat(np.arange(rig.vertex_count), rig.skin_joints.shape[1])
    used = rig.skin_weights.ravel() > 0
    skins[rows[used], rig.skin_joints.ravel()[used]] = True
    face_of_corner = np.repeat(
        np.arange(len(rig.face_starts)), np.diff(np.append(rig.face_starts, len(rig.face_vertices)))
    )
    joints = {}
    for partition in partitions:
        own = np.zeros(rig.vertex_count, bool)
        own[partition.vertices] = True
        touched = np.unique(face_of_corner[own[rig.face_vertices]])
        own[rig.face_vertices[np.isin(face_of_corner, touched)]] = True
        found = {partition.joint, *np.flatnonzero(skins[own].any(axis=0)).tolist()}
        found |= {rig.joints[joint].parent for joint in found if rig.joints[joint].parent >= 0}
        if sags:
            above = rig.joints[partition.joint].parent
            while above >= 0:
                found.add(above)
                above = rig.joints[above].parent
        elif len({_root_of(rig, joint) for joint in found}) == 1:
            found -= {_root_of(rig, partition.joint)}
        joints[partition.joint] = tuple(sorted(found))
    controls = {partition.joint: tuple(range(len(rig.controls))) for partition in partitions}
    merged = {joint: partition.joint for partition in partitions for joint in partition.merged}
    return make_partitions(rig, joints, controls, merged)


def _root_of(rig: Rig, joint: int) -> int:
    while rig.joints[joint].parent >= 0:
        joint = rig.joints[joint].parent
    return joint


def max_residual_changes(partitions: tuple[Partition, ...], moved: np.ndarray, base: np.ndarray) -> np.ndarray:
    """How far local residuals move between poses, the most in each partition.

    Args:
        partitions: P partitions.
        moved: (N, V, 3) float32 local residuals, mesh units.
        base: the same of other poses, or of one for all.

    Returns:
        (N, P) float64, mesh units.
    """
    distances = np.linalg.norm(moved - base, axis=2)
    return np.stack([distances[:, p.vertices].max(axis=1, initial=0) for p in partitions], axis=1).astype(np.float64)


def partition_colors(partitions: tuple[Partition, ...], vertex_count: int) -> np.ndarray:
    """A colour for each partition: (V, 3) float32 sRGB, 0 to 1, by vertex."""
    colors = np.zeros((vertex_count, 3), np.float32)
    for number, partition in enumerate(partitions):
        # Steps of the golden ratio keep neighbours apart, whatever their number.
        value = 0.95 if number % 2 else 0.75
        colors[partition.vertices] = colorsys.hsv_to_rgb(number * GOLDEN_RATIO % 1, 0.62, value)
    return colors
