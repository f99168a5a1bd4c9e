# SPDX-License-Identifier: GPL-3.0-or-later
"""Partitions: the vertices that share a main joint, and the joints that move their residuals."""

import colorsys
from dataclasses import dataclass

import numpy as np

from ..rig import Rig
from ..settings import MIN_VERTICES_PER_PART

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
    """Find the joint with the largest skin weight at each vertex; the first one on a tie.

    Reference: Bailey et al. 2018, section 3.1.

    Args:
        skin_joints: (V, I) int32. skin_weights: (V, I) float32.

    Returns:
        (V,) int32 joint indices.
    """
    slots = np.argmax(skin_weights, axis=1)
    return np.take_along_axis(skin_joints, slots[:, None], axis=1)[:, 0].astype(np.int32)


def joints_with_weight(skin_joints: np.ndarray, skin_weights: np.ndarray, joint_count: int) -> np.ndarray:
    """Return (V, J) bool, the joints with a weight above 0 on each vertex; arguments as in `main_joints`."""
    has_weight = np.zeros((len(skin_joints), joint_count), bool)
    vertices, slots = np.nonzero(skin_weights > 0)
    has_weight[vertices, skin_joints[vertices, slots]] = True
    return has_weight


def make_partitions(
    rig: Rig,
    influencing: dict[int, tuple[int, ...]] | None = None,
    controls: dict[int, tuple[int, ...]] | None = None,
    merged: dict[int, int] | None = None,
) -> tuple[Partition, ...]:
    """Partition the mesh by main joint, in ascending order of the joints.

    Args:
        influencing: influencing joints of each partition, by main joint; None where no partition has any.
        controls: influencing controls of each partition, by main joint; None where no partition has any.
        merged: by main joint of a merged partition, the main joint of the partition into which it is merged.
    """
    main = main_joints(rig.skin_joints, rig.skin_weights)
    influencing, controls, merged = influencing or {}, controls or {}, merged or {}
    merged_joints: dict[int, list[int]] = {}
    for joint, other in sorted(merged.items()):
        main[main == joint] = other
        merged_joints.setdefault(other, []).append(joint)
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


def make_merged_partitions(rig: Rig, min_vertices: int = MIN_VERTICES_PER_PART.default) -> tuple[Partition, ...]:
    """Partition the mesh by main joint, and merge small partitions as in `small_partition_merges`."""
    return make_partitions(rig, merged=small_partition_merges(rig, min_vertices))


def small_partition_merges(rig: Rig, min_vertices: int = MIN_VERTICES_PER_PART.default) -> dict[int, int]:
    """Choose the partitions into which small partitions are merged.

    The smallest partition is merged first, into the partition whose joint has the most weight on its vertices. Without
    such weight it is merged into the partition of its nearest ancestor or descendant. A small partition without any of
    these stays as it is, and the last partition is never merged.

    Args:
        min_vertices: partitions with fewer vertices are small; 0 merges none.

    Returns:
        By main joint of a merged partition, the main joint of the partition into which it is merged.
    """
    main = main_joints(rig.skin_joints, rig.skin_weights)
    weights: dict[int, np.ndarray] = {}
    for joint in np.unique(main).tolist():
        in_partition = main == joint
        weights[joint] = np.bincount(
            rig.skin_joints[in_partition].ravel(), rig.skin_weights[in_partition].ravel(), minlength=len(rig.joints)
        )
    vertex_counts = dict(zip(*(values.tolist() for values in np.unique(main, return_counts=True)), strict=True))
    merged: dict[int, int] = {}
    unmergeable_joints: set[int] = set()
    while small_joints := [
        joint for joint in vertex_counts if vertex_counts[joint] < min_vertices and joint not in unmergeable_joints
    ]:
        joint = min(small_joints, key=lambda source: (vertex_counts[source], source))
        target_joint = _choose_merge_joint(rig, joint, weights)
        if target_joint is None:
            unmergeable_joints.add(joint)
            continue
        vertex_counts[target_joint] += vertex_counts.pop(joint)
        weights[target_joint] += weights.pop(joint)
        unmergeable_joints.discard(target_joint)
        merged = {source: target_joint if target == joint else target for source, target in merged.items()} | {
            joint: target_joint
        }
    return merged


def _choose_merge_joint(rig: Rig, joint: int, weights: dict[int, np.ndarray]) -> int | None:
    """Choose the partition into which a small partition is merged, and return its main joint; None where there is none.

    Args:
        joint: main joint of the small partition.
        weights: for each partition, by main joint, the sum of the skin weights of each joint over its vertices.
    """
    other_joints = [other for other in weights if other != joint]
    heaviest = max(other_joints, key=lambda other: weights[joint][other], default=None)
    if heaviest is None or weights[joint][heaviest] > 0:
        return heaviest
    generation_counts = {
        other: _count_generations(rig, other, joint) or _count_generations(rig, joint, other) for other in other_joints
    }
    return min(
        (other for other in other_joints if generation_counts[other]),
        key=lambda other: generation_counts[other],
        default=None,
    )


def _count_generations(rig: Rig, ancestor: int, joint: int) -> int:
    """Count the generations from an ancestor down to a joint; 0 where `ancestor` is not an ancestor of the joint."""
    generation_count = 0
    while joint >= 0 and joint != ancestor:
        joint, generation_count = rig.joints[joint].parent, generation_count + 1
    return generation_count if joint >= 0 else 0


def assume_nearby_influences(rig: Rig, partitions: tuple[Partition, ...]) -> tuple[Partition, ...]:
    """Set the influences of partitions to those that are likely, where influences cannot be detected by moving joints.

    These are the main joint, the joints with a weight on the partition or on the faces around it, their reference
    joints, and every control. A surface that sags depends on the direction of gravity, so all
    joints from the main joint up to mesh-object space are included.

    Args:
        partitions: of the rig; their influences are ignored.
    """
    has_weight = joints_with_weight(rig.skin_joints, rig.skin_weights, len(rig.joints))
    face_of_corner = np.repeat(
        np.arange(len(rig.face_starts)), np.diff(np.append(rig.face_starts, len(rig.face_vertices)))
    )
    joints, references = {}, rig.references
    for partition in partitions:
        is_near = np.zeros(rig.vertex_count, bool)
        is_near[partition.vertices] = True
        near_faces = np.unique(face_of_corner[is_near[rig.face_vertices]])
        is_near[rig.face_vertices[np.isin(face_of_corner, near_faces)]] = True
        influences = {partition.joint, *np.flatnonzero(has_weight[is_near].any(axis=0)).tolist()}
        influences |= {int(references[joint]) for joint in influences if references[joint] >= 0}
        reference = int(references[partition.joint])
        while reference >= 0:
            influences.add(reference)
            reference = int(references[reference])
        joints[partition.joint] = tuple(sorted(influences))
    controls = {partition.joint: tuple(range(len(rig.controls))) for partition in partitions}
    merged = {joint: partition.joint for partition in partitions for joint in partition.merged}
    return make_partitions(rig, joints, controls, merged)


def partition_colors(partitions: tuple[Partition, ...], vertex_count: int) -> np.ndarray:
    """Choose a color for each partition; returns (V, 3) float32 sRGB by vertex, 0 to 1."""
    colors = np.zeros((vertex_count, 3), np.float32)
    for index, partition in enumerate(partitions):
        # Hues in steps of the golden ratio remain distinct for any number of partitions.
        brightness = 0.95 if index % 2 else 0.75
        colors[partition.vertices] = colorsys.hsv_to_rgb(index * GOLDEN_RATIO % 1, 0.62, brightness)
    return colors
