# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads what renders show of objects, as numbers: transforms, visibility, geometry, and what drivers set."""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import islice
from zlib import crc32

import bpy
import numpy as np
from mathutils import Matrix

from ..rig.references import drivers_of
from ..scene.arrays import COLOR_ELEMENT, VECTOR_ELEMENT, ElementProperty, read
from ..scene.temporary_state import temporary_attributes, temporary_visibility
from .graph_reader import used_datablocks

_ATTRIBUTE_ELEMENTS = {
    "FLOAT": ElementProperty("value", np.float32),
    "FLOAT2": ElementProperty("vector", np.float32, (2,)),
    "FLOAT_VECTOR": VECTOR_ELEMENT,
    "FLOAT_COLOR": COLOR_ELEMENT,
}
"""The value of an attribute, by its type."""
_MESH_TYPES = {"CURVE", "SURFACE", "FONT", "META"}
"""Types of objects that Blender renders as meshes."""
_COMPARED_OTHERWISE = ("modifiers[", "constraints[")
"""Prefixes of paths of driven properties that change only geometry or transforms."""
MAX_INSTANCES = 20_000
MAX_VALUES = 64_000_000
"""Largest number of values that all poses store; of larger geometry, elements are left out evenly."""
MAX_DISTANCE_RATIO = 100.0
"""Distance from the world's origin, in sizes of the rig, from which positions are compared relative to it: float32."""


DrivenProperty = tuple[bpy.types.ID, bpy.types.ID, str, int]
"""A datablock, itself or its node tree, a path in the latter, and an index."""


@dataclass
class ObjectReader:
    """Reads what renders show of objects, and of the datablocks that these use.

    Attributes:
        objects: the objects.
        driven: what drivers set, as from `driven_properties` before anything is removed.
        size: size of the rig, world units.
        pose_count: number of poses in which the values are read.
        values: the values of each pose, by a text that names the datablock. Positions are relative to the size.
    """

    objects: tuple[bpy.types.Object, ...]
    driven: tuple[DrivenProperty, ...]
    size: float
    pose_count: int
    values: dict[str, list[np.ndarray]] = field(default_factory=dict)
    _stride: int = 0

    def read(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Read the values of an evaluated pose."""
        if not self._stride:
            self._stride = 1
            count = sum(map(len, self._read_pose(depsgraph).values()))
            self._stride = -(-count * self.pose_count // MAX_VALUES)
        for key, values in self._read_pose(depsgraph).items():
            self.values.setdefault(key, []).append(values)

    def _read_pose(self, depsgraph: bpy.types.Depsgraph) -> dict[str, np.ndarray]:
        pose = {_label(o): list(self._object_values(o.evaluated_get(depsgraph))) for o in self.objects}
        for instance in islice(depsgraph.object_instances, MAX_INSTANCES):
            if instance.is_instance and instance.parent and (key := _label(instance.parent.original)) in pose:
                pose[key].append(self._in_world(np.eye(4), instance.matrix_world))
        for datablock, owner, path, index in self.driven:
            evaluated = datablock.evaluated_get(depsgraph)
            value = _value_at(evaluated if datablock == owner else evaluated.node_tree, path, index)
            pose.setdefault(_label(datablock), []).append(np.array([value]))
        return {
            key: np.concatenate([np.ravel(part) for part in parts], dtype=np.float32) for key, parts in pose.items()
        }

    def _object_values(self, evaluated: bpy.types.Object) -> Iterator[np.ndarray]:
        """Yield the transform of an evaluated object, if renders show it, and the attributes of its geometry."""
        yield np.array([evaluated.hide_render])
        yield self._in_world(np.eye(4), evaluated.matrix_world)
        mesh = evaluated.to_mesh() if evaluated.type in _MESH_TYPES else None
        owners = [mesh if evaluated.type in _MESH_TYPES else evaluated.data]
        if evaluated.type == "GREASEPENCIL":
            frames = [layer.current_frame() for layer in evaluated.data.layers]
            owners = [frame.drawing for frame in frames if frame is not None]
        for attribute in (a for owner in owners for a in getattr(owner, "attributes", ())):
            if (element := _ATTRIBUTE_ELEMENTS.get(attribute.data_type)) and not attribute.name.startswith("."):
                values = read(attribute.data, element)[:: self._stride]
                yield self._in_world(values, evaluated.matrix_world) if attribute.name == "position" else values
        if mesh is not None:
            evaluated.to_mesh_clear()

    def _in_world(self, values: np.ndarray, matrix: Matrix) -> np.ndarray:
        """Return positions (n, 3) of an object, or its axes and origin (4, 4), in the world, relative to the size."""
        world = np.array(matrix)
        scale = max(self.size, np.abs(world[:3, 3]).max() / MAX_DISTANCE_RATIO)
        if values.shape[1] == 3:
            return (values @ world[:3, :3].T + world[:3, 3]) / scale
        return world[:3] / np.array([1.0, 1.0, 1.0, scale])


def differing_objects(
    before: dict[str, list[np.ndarray]], after: dict[str, list[np.ndarray]], tolerance: float
) -> dict[str, float]:
    """Compare the values of two evaluations; arguments and result as for `differing_bones`, by the names of `before`.

    A difference is infinite where the numbers of values differ.
    """
    differences: dict[str, float] = {}
    for key, poses in before.items():
        for first, second in zip(poses, after[key], strict=True):
            difference = np.inf if first.shape != second.shape else _largest_difference(first, second)
            differences[key] = max(differences.get(key, 0.0), difference)
    return {key: difference for key, difference in differences.items() if difference > tolerance}


def _largest_difference(first: np.ndarray, second: np.ndarray) -> float:
    """Return the largest difference of two arrays, relative to values above 1; infinite where only one is finite."""
    is_finite = np.isfinite(first)
    if not np.array_equal(is_finite, np.isfinite(second)):
        return np.inf
    first, second = first[is_finite], second[is_finite]
    return float((np.abs(first - second) / np.maximum(np.abs(first), 1.0)).max(initial=0.0))


@contextmanager
def objects_evaluated(objects: Iterable[bpy.types.Object]) -> Iterator[None]:
    """Let the view layer evaluate objects that only other view layers or scenes show, or that viewports hide."""
    objects, scene, view_layer = list(objects), bpy.context.scene, bpy.context.view_layer
    collection = bpy.data.collections.new("comparison")
    scene.collection.children.link(collection)
    for scene_object in objects:
        collection.objects.link(scene_object)
    view_layer.update()
    hidden = [scene_object for scene_object in objects if scene_object.hide_get()]
    try:
        with temporary_visibility(objects), ExitStack() as stack:
            for scene_object in objects:
                stack.enter_context(temporary_attributes(scene_object, hide_viewport=False))
            for scene_object in hidden:
                scene_object.hide_set(False)
            yield
    finally:
        for scene_object in hidden:
            scene_object.hide_set(True)
        bpy.data.collections.remove(collection)
        view_layer.update()


def _label(datablock: bpy.types.ID) -> str:
    return f"{datablock.id_type.lower()} '{datablock.name}'"


def driven_properties(objects: Iterable[bpy.types.Object]) -> Iterator[DrivenProperty]:
    """Yield what drivers set in objects and in what these use, such as custom properties, materials and lights."""
    used = used_datablocks()
    worlds = [scene.world for scene in bpy.data.scenes if scene.world is not None]
    pending = [*objects, *worlds]
    found = {*pending, *bpy.data.scenes}
    while pending:
        unfollowed = (bpy.types.Object, bpy.types.Armature, bpy.types.Key, bpy.types.Scene)
        new = {d for d in used.get(pending.pop(), ()) if not isinstance(d, unfollowed)} - found
        found |= new
        pending += new
    for datablock in sorted(found, key=_label):
        for owner, curve in drivers_of(datablock):
            if not curve.data_path.startswith(_COMPARED_OTHERWISE):
                yield datablock, owner, curve.data_path, curve.array_index


def _value_at(owner: bpy.types.ID, path: str, index: int) -> float:
    """Return the number at a path, or that of a text; NaN if there is none."""
    try:
        value = owner.path_resolve(path)
    except ValueError:
        return np.nan
    if isinstance(value, str):
        return float(crc32(value.encode()))
    return float(value[index] if hasattr(value, "__len__") else value)
