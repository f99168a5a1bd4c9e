# SPDX-License-Identifier: GPL-3.0-or-later
"""Computes the skin weights that Blender's Armature modifier uses.

The modifier computes them as follows (Blender's manual, Armature Modifier; blenkernel/intern/armature_deform.cc). It
reads the weights of the vertex groups of deforming bones, and multiplies them by the envelope of each bone that is set
to Multiply Vertex Group with Envelope. If the modifier uses envelopes, a vertex in none of these groups is weighted by
the envelopes of all deforming bones. The modifier divides the weights of each vertex by their sum, and does not move a
vertex whose sum is nearly zero. The vertex group of the modifier itself scales the deformation.
"""

from dataclasses import dataclass

import bpy
import numpy as np

from ..core.rig import STATIC_JOINT
from .mesh import group_weights, rest_positions

MIN_INFLUENCES = 4
"""Smallest number of columns of skin weight arrays (docs/formats.md)."""
MIN_WEIGHT_SUM = 1e-4
"""The modifier does not move a vertex whose weights have a smaller sum."""


@dataclass(frozen=True)
class Skin:
    """Skin weights of a mesh, one entry for each pair of a vertex and a bone with a weight.

    Attributes:
        bones: names of the bones that have weights; includes `STATIC_JOINT` if a vertex does not follow bones entirely.
        vertices: (n,) int64, ascending.
        bone_indices: (n,) int64 indices into `bones`.
        weights: (n,) float32; those of a vertex sum to 1.
        vertex_count: number of vertices of the mesh.
    """

    bones: tuple[str, ...]
    vertices: np.ndarray
    bone_indices: np.ndarray
    weights: np.ndarray
    vertex_count: int

    def arrays(self, joints: dict[str, int]) -> tuple[np.ndarray, np.ndarray]:
        """Convert the weights to dense arrays.

        Args:
            joints: joint indices by name.

        Returns:
            skin_joints (V, I) int32 and skin_weights (V, I) float32, rows of weights sum to 1; I is 4 or more.
        """
        influence_counts = np.bincount(self.vertices, minlength=self.vertex_count)
        shape = (self.vertex_count, max(MIN_INFLUENCES, int(influence_counts.max(initial=0))))
        skin_joints, skin_weights = np.zeros(shape, np.int32), np.zeros(shape, np.float32)
        columns = np.arange(len(self.vertices)) - np.repeat(
            np.cumsum(influence_counts) - influence_counts, influence_counts
        )
        skin_joints[self.vertices, columns] = np.array([joints[name] for name in self.bones], np.int32)[
            self.bone_indices
        ]
        skin_weights[self.vertices, columns] = self.weights
        return skin_joints, skin_weights


def read_skin(
    mesh_object: bpy.types.Object, armature_object: bpy.types.Object, modifier: bpy.types.ArmatureModifier | None
) -> Skin:
    """Read the skin weights of a mesh.

    Args:
        armature_object: the armature object that deforms it.
        modifier: the Armature modifier; None if there is none, so that no vertex follows a bone.
    """
    vertex_count = len(mesh_object.data.vertices)
    bones = [bone for bone in armature_object.data.bones if bone.use_deform]
    parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32))]
    if modifier is not None:
        if modifier.use_vertex_groups:
            parts.append(_group_weights(mesh_object, armature_object, bones))
        ungrouped = np.setdiff1d(np.arange(vertex_count), parts[-1][0])
        if modifier.use_bone_envelopes and len(ungrouped):
            parts.append(_envelope_weights(mesh_object, armature_object, bones, ungrouped))
    vertices, indices, weights = map(np.concatenate, zip(*parts, strict=True))
    factors = _modifier_factors(mesh_object, modifier, vertex_count)
    factors[np.bincount(vertices, weights, vertex_count) <= MIN_WEIGHT_SUM] = 0
    is_used = (weights > 0) & (factors[vertices] > 0)
    vertices, indices, weights = vertices[is_used], indices[is_used], weights[is_used]
    weights = weights / np.bincount(vertices, weights, vertex_count).astype(np.float32)[vertices]
    static = np.flatnonzero(factors < 1)
    weights = np.concatenate([weights * factors[vertices].astype(np.float32), (1 - factors[static]).astype(np.float32)])
    vertices = np.concatenate([vertices, static])
    indices = np.concatenate([indices, np.full(len(static), len(bones))])
    order = np.argsort(vertices, kind="stable")
    bone_names = np.array([*(bone.name for bone in bones), STATIC_JOINT], object)
    used_bones, bone_indices = np.unique(indices[order], return_inverse=True)
    return Skin(tuple(bone_names[used_bones]), vertices[order], bone_indices, weights[order], vertex_count)


Entries = tuple[np.ndarray, np.ndarray, np.ndarray]
"""As in `Skin`: vertices, indices into all deforming bones, and weights that are not yet divided by their sum."""


def _group_weights(
    mesh_object: bpy.types.Object, armature_object: bpy.types.Object, bones: list[bpy.types.Bone]
) -> Entries:
    """Read the weights of vertex groups of deforming bones; a weight may be 0."""
    bone_indices = {bone.name: index for index, bone in enumerate(bones)}
    groups = {g.index: bone_indices[g.name] for g in mesh_object.vertex_groups if g.name in bone_indices}
    rows = [
        (vertex.index, groups[element.group], element.weight)
        for vertex in mesh_object.data.vertices
        for element in vertex.groups
        if element.group in groups
    ]
    columns = zip(*rows, strict=True) if rows else ((), (), ())
    vertices, indices, weights = map(np.array, columns, (np.int64, np.int64, np.float32))
    if any(bone.use_envelope_multiply for bone in bones):
        points = _rest_points(mesh_object, armature_object, vertices)
        for bone_index, bone in enumerate(bones):
            if bone.use_envelope_multiply:
                of_bone = np.flatnonzero(indices == bone_index)
                weights[of_bone] *= _envelope(bone, points[of_bone])
    return vertices, indices, weights


def _envelope_weights(
    mesh_object: bpy.types.Object, armature_object: bpy.types.Object, bones: list[bpy.types.Bone], vertices: np.ndarray
) -> Entries:
    """Compute the weights of the envelopes of all bones for some vertices, given by their (n,) int64 indices."""
    points = _rest_points(mesh_object, armature_object, vertices)
    weights = np.array([_envelope(bone, points) * bone.envelope_weight for bone in bones]).reshape(
        len(bones), len(points)
    )
    indices, rows = np.nonzero(weights > 0)
    return vertices[rows], indices, weights[indices, rows].astype(np.float32)


def _envelope(bone: bpy.types.Bone, points: np.ndarray) -> np.ndarray:
    """Evaluate a bone's envelope at points: 1 inside its radius, decreasing to 0 over its distance.

    This is `Bone.evaluate_envelope` for many points, without the envelope weight that it includes for multiplying
    envelopes.

    Args:
        points: (n, 3) float64, armature space, its units.

    Returns:
        (n,) float64, 0 to 1.
    """
    head, axis = np.array(bone.head_local), np.array(bone.tail_local) - np.array(bone.head_local)
    fraction = np.clip((points - head) @ axis / max(axis @ axis, 1e-30), 0, 1)
    radius = bone.head_radius + fraction * (bone.tail_radius - bone.head_radius)
    distance = np.linalg.norm(points - head - fraction[:, None] * axis, axis=1) - radius
    if bone.envelope_distance == 0:
        return (distance < 0).astype(np.float64)
    return 1 - np.clip(distance / bone.envelope_distance, 0, 1) ** 2


def _rest_points(mesh_object: bpy.types.Object, armature_object: bpy.types.Object, vertices: np.ndarray) -> np.ndarray:
    """Return the rest positions of some vertices, (n, 3) float64, armature space, armature units."""
    to_armature = np.array(armature_object.matrix_world.inverted_safe() @ mesh_object.matrix_world, np.float64)
    points = rest_positions(mesh_object.data)[vertices].astype(np.float64)
    return points @ to_armature[:3, :3].T + to_armature[:3, 3]


def _modifier_factors(
    mesh_object: bpy.types.Object, modifier: bpy.types.ArmatureModifier | None, vertex_count: int
) -> np.ndarray:
    """Return the factor by which the modifier's vertex group scales the deformation of each vertex, (V,) float64."""
    if modifier is None:
        return np.zeros(vertex_count)
    weights = group_weights(mesh_object, {modifier.vertex_group} - {""}).get(modifier.vertex_group)
    if weights is None:
        return np.ones(vertex_count)
    weights = weights.astype(np.float64)
    return 1 - weights if modifier.invert_vertex_group else weights
