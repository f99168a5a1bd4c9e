# SPDX-License-Identifier: GPL-3.0-or-later
"""Skin weights as Blender's Armature modifier takes them.

The rules of the modifier (Blender's manual, Armature Modifier; blenkernel/intern/armature_deform.cc): weights of the
vertex groups of deforming bones, times the bone's envelope where it multiplies; the envelopes of all deforming bones
for a vertex that is in none of these groups, where the modifier uses envelopes; divided by their sum; a sum of nearly
nothing leaves the vertex where it is. So does the modifier's own vertex group, by its weight.
"""

from dataclasses import dataclass

import bpy
import numpy as np

from ..core.rig import STATIC_JOINT
from .mesh import rest_positions

MIN_INFLUENCES = 4
"""Skin weights have at least this many places a vertex (docs/formats.md)."""
MIN_SUM = 1e-4
"""A vertex whose weights sum to less is not moved by the modifier."""


@dataclass(frozen=True)
class Skin:
    """Weights of a mesh, one entry for each vertex and bone with a weight.

    Attributes:
        bones: names of the bones that have weights, `STATIC_JOINT` where something follows no bone.
        vertices: (n,) int64, ascending.
        places: (n,) int64 indices into `bones`.
        weights: (n,) float32; those of a vertex sum to 1.
        vertex_count: of the mesh.
    """

    bones: tuple[str, ...]
    vertices: np.ndarray
    places: np.ndarray
    weights: np.ndarray
    vertex_count: int

    def arrays(self, joints: dict[str, int]) -> tuple[np.ndarray, np.ndarray]:
        """Dense arrays for joint indices by name.

        Returns:
            skin_joints (V, I) int32 and skin_weights (V, I) float32, rows of weights sum to 1; I is 4 or more.

        Raises:
            KeyError: a bone that has weights is no joint.
        """
        counts = np.bincount(self.vertices, minlength=self.vertex_count)
        shape = (self.vertex_count, max(MIN_INFLUENCES, int(counts.max(initial=0))))
        skin_joints, skin_weights = np.zeros(shape, np.int32), np.zeros(shape, np.float32)
        slots = np.arange(len(self.vertices)) - np.repeat(np.cumsum(counts) - counts, counts)
        skin_joints[self.vertices, slots] = np.array([joints[name] for name in self.bones], np.int32)[self.places]
        skin_weights[self.vertices, slots] = self.weights
        return skin_joints, skin_weights


def read_skin(
    mesh_object: bpy.types.Object, armature_object: bpy.types.Object, modifier: bpy.types.ArmatureModifier | None
) -> Skin:
    """Read the weights of a mesh.

    Args:
        mesh_object: the mesh object.
        armature_object: whose bones deform it.
        modifier: the Armature modifier; None where there is none, and nothing follows a bone.
    """
    count = len(mesh_object.data.vertices)
    bones = [bone for bone in armature_object.data.bones if bone.use_deform]
    entries = _Entries(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32))
    if modifier is not None:
        grouped = np.zeros(count, bool)
        if modifier.use_vertex_groups:
            entries, grouped = _of_groups(mesh_object, armature_object, bones)
        if modifier.use_bone_envelopes and not grouped.all():
            entries = entries.joined(_of_envelopes(mesh_object, armature_object, bones, np.flatnonzero(~grouped)))
    kept = _moved_parts(mesh_object, modifier, count)
    sums = np.bincount(entries.vertices, entries.weights, count)
    kept[sums <= MIN_SUM] = 0
    entries = entries.chosen((entries.weights > 0) & (kept[entries.vertices] > 0))
    weights = (
        entries.weights / np.bincount(entries.vertices, entries.weights, count).astype(np.float32)[entries.vertices]
    )
    entries = _Entries(entries.vertices, entries.places, weights * kept[entries.vertices].astype(np.float32))
    unmoved = np.flatnonzero(kept < 1)
    here = np.full(len(unmoved), len(bones))
    entries = entries.joined(_Entries(unmoved, here, (1 - kept[unmoved]).astype(np.float32))).sorted()
    names = np.array([*(bone.name for bone in bones), STATIC_JOINT], object)
    used, places = np.unique(entries.places, return_inverse=True)
    return Skin(tuple(names[used]), entries.vertices, places, entries.weights, count)


@dataclass(frozen=True)
class _Entries:
    """As in `Skin`, with indices into all deforming bones; weights not yet divided by their sum."""

    vertices: np.ndarray
    places: np.ndarray
    weights: np.ndarray

    def joined(self, other: "_Entries") -> "_Entries":
        pairs = ((getattr(own, name) for own in (self, other)) for name in ("vertices", "places", "weights"))
        return _Entries(*(np.concatenate(list(pair)) for pair in pairs))

    def chosen(self, mask: np.ndarray) -> "_Entries":
        return _Entries(self.vertices[mask], self.places[mask], self.weights[mask])

    def sorted(self) -> "_Entries":
        return self.chosen(np.argsort(self.vertices, kind="stable"))


def _of_groups(
    mesh_object: bpy.types.Object, armature_object: bpy.types.Object, bones: list[bpy.types.Bone]
) -> tuple[_Entries, np.ndarray]:
    """Weights of vertex groups, and (V,) whether a vertex is in a group of a deforming bone, whatever its weight."""
    place_of_bone = {bone.name: place for place, bone in enumerate(bones)}
    place_of_group = {
        group.index: place_of_bone[group.name] for group in mesh_object.vertex_groups if group.name in place_of_bone
    }
    rows = [
        (vertex.index, place_of_group[g.group], g.weight)
        for vertex in mesh_object.data.vertices
        for g in vertex.groups
        if g.group in place_of_group
    ]
    vertices, places, weights = zip(*rows, strict=True) if rows else ((), (), ())
    entries = _Entries(np.array(vertices, np.int64), np.array(places, np.int64), np.array(weights, np.float32))
    grouped = np.zeros(len(mesh_object.data.vertices), bool)
    grouped[entries.vertices] = True
    if any(bone.use_envelope_multiply for bone in bones):
        entries = _multiplied(mesh_object, armature_object, bones, entries)
    return entries, grouped


def _multiplied(
    mesh_object: bpy.types.Object, armature_object: bpy.types.Object, bones: list[bpy.types.Bone], entries: _Entries
) -> _Entries:
    """Weights times the envelopes of the bones that are set to multiply."""
    weights = entries.weights.copy()
    points = _rest_points(mesh_object, armature_object, np.arange(len(mesh_object.data.vertices)))
    for place, bone in enumerate(bones):
        if bone.use_envelope_multiply:
            own = np.flatnonzero(entries.places == place)
            weights[own] *= _envelope(bone, points[entries.vertices[own]])
    return _Entries(entries.vertices, entries.places, weights)


def _of_envelopes(
    mesh_object: bpy.types.Object, armature_object: bpy.types.Object, bones: list[bpy.types.Bone], vertices: np.ndarray
) -> _Entries:
    """Weights of the envelopes of all bones on some vertices."""
    points = _rest_points(mesh_object, armature_object, vertices)
    factors = [_envelope(bone, points) * bone.envelope_weight for bone in bones]
    found = [np.flatnonzero(own > 0) for own in factors]
    return _Entries(
        np.concatenate([np.zeros(0, np.int64), *(vertices[own] for own in found)]),
        np.repeat(np.arange(len(bones)), [len(own) for own in found]),
        np.concatenate([np.zeros(0), *(own[chosen] for own, chosen in zip(factors, found, strict=True))]).astype(
            np.float32
        ),
    )


def _envelope(bone: bpy.types.Bone, points: np.ndarray) -> np.ndarray:
    """How much a bone's envelope holds points: 1 inside its radius, falling to 0 over its distance.

    `Bone.evaluate_envelope` for many points, without the weight that it takes in where the envelope multiplies.

    Args:
        bone: the bone.
        points: (n, 3) float64, armature space, its units.

    Returns:
        (n,) float64, 0 to 1.
    """
    head, along = np.array(bone.head_local), np.array(bone.tail_local) - np.array(bone.head_local)
    place = np.clip((points - head) @ along / max(along @ along, 1e-30), 0, 1)
    radius = bone.head_radius + place * (bone.tail_radius - bone.head_radius)
    beyond = np.linalg.norm(points - head - place[:, None] * along, axis=1) - radius
    if bone.envelope_distance == 0:
        return (beyond < 0).astype(np.float64)
    return 1 - np.clip(beyond / bone.envelope_distance, 0, 1) ** 2


def _rest_points(mesh_object: bpy.types.Object, armature_object: bpy.types.Object, vertices: np.ndarray) -> np.ndarray:
    """(n, 3) float64 rest positions of some vertices in armature space, its units."""
    to_armature = np.array(armature_object.matrix_world.inverted_safe() @ mesh_object.matrix_world, np.float64)
    points = rest_positions(mesh_object.data)[vertices].astype(np.float64)
    return points @ to_armature[:3, :3].T + to_armature[:3, 3]


def _moved_parts(mesh_object: bpy.types.Object, modifier: bpy.types.ArmatureModifier | None, count: int) -> np.ndarray:
    """(V,) float64 how far the modifier moves each vertex, by its vertex group."""
    if modifier is None:
        return np.zeros(count)
    group = mesh_object.vertex_groups.get(modifier.vertex_group) if modifier.vertex_group else None
    if group is None:
        return np.ones(count)
    weights = np.zeros(count)
    for vertex in mesh_object.data.vertices:
        weights[vertex.index] = next((g.weight for g in vertex.groups if g.group == group.index), 0.0)
    return 1 - weights if modifier.invert_vertex_group else weights
