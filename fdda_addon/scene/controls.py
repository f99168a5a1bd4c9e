# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds, reads the defaults of, and sets controls: numbers of a rig that are inputs of a model besides its joints."""

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType

import bpy
import numpy as np

from ..core.controls import (
    ARMATURE,
    ARMATURE_OBJECT,
    EVALUATION_TIME,
    MESH_OBJECT,
    MESH_OWNER,
    OTHER_OBJECT,
    OWNERS,
    SHAPE_KEY_PATH,
    SHAPE_KEYS,
    Control,
)
from ..core.errors import RigError
from .scene_rig import SceneRig, armature_of, name_without_number
from .temporary_state import animation_state, restore_animation

_BONE_TRANSFORM_PATH = re.compile(
    r'(?P<bone>pose\.bones\["(?P<name>(?:[^"\\]|\\.)*)"\])\.'
    r"(?P<property>location|scale|rotation_\w+|matrix_basis)\[(?P<index>\d)\](?:\[(?P<row>[0-3])\])?"
)

MATRIX = "matrix_basis"
"""RNA property of a pose bone: the 4x4 transform that its channels define, relative to its rest pose, without its
constraints. `matrix_basis[C][R]` is the element in column C and row R. A control on it can be read but not set."""

MATRIX_ELEMENT_RANGE = (-1.0, 1.0)
"""Range of an element of a rotation matrix."""


@dataclass(frozen=True)
class BoneTransform:
    """The number of a bone's transform that a control is.

    Attributes:
        bone_path: RNA path of the pose bone in its armature object.
        bone_name: name of the bone.
        element: column and row of the number in `MATRIX`; None for a scale or a rotation channel.
        is_matrix: the path of the control is an element of `MATRIX`.
        scale_axis: axis of a scale; None for any other number.
    """

    bone_path: str
    bone_name: str
    element: tuple[int, int] | None
    is_matrix: bool
    scale_axis: int | None


def bone_transform(path: str) -> BoneTransform | None:
    """Return the number of a bone's transform at the path of a control; None for any other number."""
    match = _BONE_TRANSFORM_PATH.fullmatch(path)
    is_matrix = match is not None and match["property"] == MATRIX
    if match is None or is_matrix != (match["row"] is not None):
        return None
    element = (int(match["index"]), int(match["row"])) if is_matrix else None
    if match["property"] == "location":
        element = 3, int(match["index"])
    scale_axis = int(match["index"]) if match["property"] == "scale" else None
    return BoneTransform(match["bone"], bpy.utils.unescape_identifier(match["name"]), element, is_matrix, scale_axis)


def controls_by_bone(controls: Iterable[Control]) -> dict[str, tuple[int, ...]]:
    """Return the indices of the controls that are numbers of a bone's transform, by the name of the bone.

    Bones of other armatures are left out.
    """
    indices: dict[str, list[int]] = {}
    for index, control in enumerate(controls):
        transform = bone_transform(control.path) if control.owner == ARMATURE_OBJECT else None
        if transform is not None:
            indices.setdefault(transform.bone_name, []).append(index)
    return {name: tuple(bone_indices) for name, bone_indices in indices.items()}


MAX_RANGE_WIDTH = 1e4
"""A property with a wider range is treated as a property without a range."""

_CONTROL_TEXT = re.compile(r"(?P<name>.+?)(?:=(?P<low>[-+.\deE]+):(?P<high>[-+.\deE]+))?", re.DOTALL)

_CUSTOM_PROPERTY_PATH = re.compile(r'(?P<owner>.*)\["(?P<name>(?:[^"\\]|\\.)*)"\]')

_ARRAY_ELEMENT_PATH = re.compile(r"(?P<array>.+)\[(?P<index>\d+)\]")

_STRUCT_INDEX = re.compile(r"\.?\[\s*(?P<index>\d+)\s*\](?=[.\[])")

_AXIS_PATH = re.compile(r"(?P<array>.+)\.(?P<axis>[wxyz])")


def owner_of(scene_rig: SceneRig, owner: str) -> bpy.types.ID | None:
    """Return the datablock that `Control.owner` names for a rig; None if it does not exist."""
    mesh_object = scene_rig.mesh_object
    if owner.startswith(OTHER_OBJECT):
        return bpy.data.objects.get(owner.removeprefix(OTHER_OBJECT))
    if match := MESH_OWNER.fullmatch(owner):
        mesh_object = dict(scene_rig.other_meshes).get(match["mesh"]) or _find_other_mesh(scene_rig, match["mesh"])
        owner = match["owner"]
        if mesh_object is None:
            return None
    return {
        ARMATURE_OBJECT: scene_rig.armature_object,
        ARMATURE: scene_rig.armature_object.data,
        MESH_OBJECT: mesh_object,
        SHAPE_KEYS: mesh_object.data.shape_keys,
    }.get(owner)


def _find_other_mesh(scene_rig: SceneRig, name: str) -> bpy.types.Object | None:
    """Find the mesh object on the armature of a rig that is a mesh of its recording or model; return None without one.

    An object that plays a model has the name of its mesh in the model; others are found by their own names.
    """
    named_object = bpy.data.objects.get(name)
    for mesh_object in (*([named_object] if named_object else []), *bpy.data.objects):
        if (
            mesh_object.type == "MESH"
            and name == (mesh_object.fdda.model_mesh or name_without_number(mesh_object))
            and armature_of(mesh_object) == scene_rig.armature_object
        ):
            return mesh_object
    return None


def owner_name(scene_rig: SceneRig, datablock: bpy.types.ID | None) -> str:
    """Return the name of a datablock as `Control.owner`; empty for none, and for one that cannot have controls."""
    if datablock is None:
        return ""
    mesh_owners = (f"{owner}:{name}" for name, _ in scene_rig.other_meshes for owner in (MESH_OBJECT, SHAPE_KEYS))
    for owner in (ARMATURE_OBJECT, ARMATURE, MESH_OBJECT, SHAPE_KEYS, *mesh_owners):
        if owner_of(scene_rig, owner) == datablock:
            return owner
    return f"{OTHER_OBJECT}{datablock.name}" if isinstance(datablock, bpy.types.Object) else ""


def make_control(
    scene_rig: SceneRig,
    owner: str,
    path: str,
    bounds: tuple[float, float] | None = None,
    sampled_ranges: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> Control:
    """Make a control of a rig.

    Args:
        owner, path: as in `Control`.
        bounds: the range of the control; None for the range of its property.
        sampled_ranges: ranges of the numbers that random poses set, by the names of their controls. They take
            precedence over the ranges of properties.

    Raises:
        RigError: there is no such number, or it has no range.
    """
    datablock = owner_of(scene_rig, owner)
    path = canonical_path(datablock, path) if datablock else path
    name = f"{owner}/{path}"
    if not is_number(datablock, path):
        raise RigError(
            f"'{scene_rig.mesh_object.name}' has no control '{name}'; give the name of a shape key, or OWNER/PATH of a "
            f"number, with OWNER one of {', '.join(OWNERS)} and {OTHER_OBJECT}NAME."
        )
    low, high = bounds or sampled_ranges.get(name) or _property_range(datablock, path)
    if not low < high or high - low > MAX_RANGE_WIDTH:
        raise RigError(f"The control '{name}' has no range; give one: '{name}=LOW:HIGH'.")
    return Control(owner, path, float(low), float(high))


def parse_controls(
    scene_rig: SceneRig, texts: Iterable[str], sampled_ranges: Mapping[str, tuple[float, float]] = MappingProxyType({})
) -> tuple[Control, ...]:
    """Parse controls as a user lists them.

    Args:
        texts: each is OWNER/PATH or the name of a shape key, with an optional =LOW:HIGH that overrides the range of the
            property.
        sampled_ranges: as for `make_control`.

    Raises:
        RigError: as `make_control`.
    """
    controls: dict[str, Control] = {}
    for text in texts:
        match = _CONTROL_TEXT.fullmatch(text)
        name, bounds = match["name"], None
        if match["low"]:
            try:
                bounds = float(match["low"]), float(match["high"])
            except ValueError as error:
                raise RigError(
                    f"'{text}' has an invalid range; write it as NAME=LOW:HIGH, with two numbers."
                ) from error
        all_keys = [keys for mesh_object in scene_rig.mesh_objects if (keys := mesh_object.data.shape_keys)]
        key_path = f'key_blocks["{bpy.utils.escape_identifier(name)}"].value'
        names = [
            f"{owner_name(scene_rig, keys)}/{key_path}"
            for keys in all_keys
            if name in keys.key_blocks and name != keys.reference_key.name
        ]
        for owner_and_path in names or [name]:
            owner, _, path = owner_and_path.partition("/")
            control = make_control(scene_rig, owner, path, bounds, sampled_ranges)
            controls[control.name] = control
    return tuple(controls.values())


def can_be_set(name: str) -> bool:
    """Return whether `set_control` can set a control, given its name: not an element of `MATRIX`."""
    transform = bone_transform(name.partition("/")[2])
    return transform is None or not transform.is_matrix


def is_driven(datablock: bpy.types.ID, path: str) -> bool:
    """Return whether a driver sets a number."""
    owner, array_path, index = fcurve_target(datablock, path)
    return (array_path, index) in driven_numbers(owner)


def driven_numbers(datablock: bpy.types.ID | None) -> set[tuple[str, int]]:
    """Return path and array index of each number of a datablock that a driver sets."""
    curves = datablock.animation_data.drivers if datablock is not None and datablock.animation_data else ()
    return {(canonical_path(datablock, curve.data_path), curve.array_index) for curve in curves}


def custom_properties(datablock: bpy.types.ID, owner_path: str) -> list[str]:
    """Return the paths of the undriven numeric custom properties of a datablock, or of a struct in it."""
    struct = datablock.path_resolve(owner_path) if owner_path else datablock
    paths = [f'{owner_path}["{bpy.utils.escape_identifier(name)}"]' for name, _ in struct.items()]
    return [path for path in paths if is_number(datablock, path) and not is_driven(datablock, path)]


def is_number(datablock: bpy.types.ID | None, path: str) -> bool:
    """Return whether a path of a datablock leads to a number."""
    return datablock is not None and number_at(datablock, path) is not None


def canonical_path(datablock: bpy.types.ID, path: str) -> str:
    """Write a path as Blender does: elements by their names, and an axis by its index.

    `pose.bones[3].location.x` becomes `pose.bones["hand"].location[0]`. A path that leads nowhere does not change.
    """
    position = 0
    while match := _STRUCT_INDEX.search(path, position):
        position, index = match.end(), int(match["index"])
        elements = _value_at(datablock, path[: match.start()])
        is_found = isinstance(elements, bpy.types.bpy_prop_collection) and index < len(elements)
        if is_found and (name := _element_name(elements[index])):
            named_path = f'{path[: match.start()]}["{bpy.utils.escape_identifier(name)}"]'
            path, position = named_path + path[match.end() :], len(named_path)
    match = _AXIS_PATH.fullmatch(path)
    array = _value_at(datablock, match["array"]) if match else None
    if hasattr(array, "__len__") and not isinstance(array, str):
        axes = "wxyz" if match["array"].endswith(("_quaternion", "_axis_angle")) else "xyzw"
        path = f"{match['array']}[{axes.index(match['axis'])}]"
    return path


def _element_name(element: bpy.types.bpy_struct) -> str:
    """Return the name by which Blender writes an element in paths; empty if it writes its number, as of sockets."""
    if isinstance(element, bpy.types.ID):
        return element.name
    try:
        return element.name if element.path_from_id().endswith('"]') else ""
    except (AttributeError, ValueError):
        return ""


def _value_at(datablock: bpy.types.ID, path: str) -> object:
    """Return the value at a path; None if there is none."""
    try:
        return datablock.path_resolve(path)
    except ValueError:
        return None


def _split_index(path: str) -> tuple[str, int | None]:
    """Split the path of an array element into array path and index; the index of another path is None."""
    match = _ARRAY_ELEMENT_PATH.fullmatch(path)
    return (match["array"], int(match["index"])) if match else (path, None)


def parent_and_name(datablock: bpy.types.ID, path: str) -> tuple[bpy.types.bpy_struct, str, int | None]:
    """Return the struct that has the property at a path, the property's name, and the index in an array or None.

    The name of a custom property is `["NAME"]`.
    """
    array_path, index = _split_index(path)
    if match := _CUSTOM_PROPERTY_PATH.fullmatch(array_path):
        owner_path, name = match["owner"], array_path[len(match["owner"]) :]
    else:
        owner_path, _, name = array_path.rpartition(".")
    return datablock.path_resolve(owner_path) if owner_path else datablock, name, index


def fcurve_target(datablock: bpy.types.ID, path: str) -> tuple[bpy.types.ID, str, int]:
    """Return the datablock, the property path and the array index with which an F-curve animates a number.

    The datablock may be another one than the given one: a path of a lattice object may lead to its shape keys.
    """
    path = canonical_path(datablock, path)
    array_path, index = _split_index(path)
    try:
        struct, name, _ = parent_and_name(datablock, path)
        prefix = "" if struct == struct.id_data else struct.path_from_id()
    except ValueError:
        return datablock, array_path, index or 0
    return struct.id_data, prefix + name if is_custom_property(name) or not prefix else f"{prefix}.{name}", index or 0


def is_custom_property(name: str) -> bool:
    """Return whether a property name from `parent_and_name` names a custom property."""
    return name.startswith('["')


def custom_property_key(name: str) -> str:
    """Return the key of a custom property, given its name from `parent_and_name`."""
    return bpy.utils.unescape_identifier(name[2:-2])


def write_value(datablock: bpy.types.ID, path: str, value: object) -> None:
    """Set the value at a path. Setting a custom property does not tag its datablock."""
    struct, name, index = parent_and_name(datablock, path)
    if index is not None:
        datablock.path_resolve(_split_index(path)[0])[index] = value
    elif is_custom_property(name):
        struct[custom_property_key(name)] = value
    else:
        setattr(struct, name, value)


def number_at(datablock: bpy.types.ID, path: str) -> float | None:
    """Return the number at a path; None if there is none."""
    value = _value_at(datablock, path)
    return float(value) if isinstance(value, int | float) and np.isfinite(value) else None


def _property_range(datablock: bpy.types.ID, path: str) -> tuple[float, float]:
    transform = bone_transform(path)
    if transform is not None and transform.is_matrix:
        # The last column is the location, which has no range.
        return MATRIX_ELEMENT_RANGE if transform.element[0] < 3 else (0.0, 0.0)
    struct, name, _ = parent_and_name(datablock, path)
    if is_custom_property(name):
        key = custom_property_key(name)
        if isinstance(struct[key], bool):
            return 0.0, 1.0
        settings = struct.id_properties_ui(key).as_dict()
        return _narrower_range(*((settings[f"{prefix}min"], settings[f"{prefix}max"]) for prefix in ("soft_", "")))
    if isinstance(struct, bpy.types.ShapeKey) and name == "value":
        return struct.slider_min, struct.slider_max
    if isinstance(struct, bpy.types.Key) and name == EVALUATION_TIME:
        frames = [block.frame for block in struct.key_blocks]
        return min(frames), max(frames)
    prop = struct.bl_rna.properties[name]
    if prop.type == "BOOLEAN":
        return 0.0, 1.0
    return _narrower_range((prop.soft_min, prop.soft_max), (prop.hard_min, prop.hard_max))


def _narrower_range(soft_range: tuple[float, float], hard_range: tuple[float, float]) -> tuple[float, float]:
    return soft_range if soft_range[1] - soft_range[0] <= hard_range[1] - hard_range[0] else hard_range


def set_control(scene_rig: SceneRig, name: str, value: float) -> None:
    """Set a control by its name without evaluating it (`can_be_set`); integers and booleans are rounded."""
    owner, _, path = name.partition("/")
    datablock = owner_of(scene_rig, owner)
    current = datablock.path_resolve(path)
    write_value(datablock, path, type(current)(round(value)) if isinstance(current, bool | int) else value)
    # Custom properties do not tag their datablock.
    datablock.update_tag()


@contextmanager
def temporary_controls(scene_rig: SceneRig, names: Iterable[str]) -> Iterator[None]:
    """Remove the animation of controls, given by name; restore it and their values afterwards.

    `temporary_state.temporary_pose` does the same for the animation of the armature object and for transforms of bones.
    """
    names = [name for name in names if can_be_set(name)]
    owners_and_paths = [
        (owner_of(scene_rig, owner), path) for owner, _, path in (name.partition("/") for name in names)
    ]
    owners = {fcurve_target(*owner_and_path)[0] for owner_and_path in owners_and_paths} - {scene_rig.armature_object}
    states = [(owner, animation_state(owner)) for owner in owners if owner.animation_data is not None]
    values = {name: owner_of(scene_rig, name.partition("/")[0]).path_resolve(name.partition("/")[2]) for name in names}
    for owner, _ in states:
        owner.animation_data.use_nla, owner.animation_data.action = False, None
    try:
        yield
    finally:
        for owner, state in states:
            restore_animation(owner, state)
        for name, value in values.items():
            set_control(scene_rig, name, value)


_FULL_DATA_PATH = re.compile(r'bpy\.data\.(?P<collection>\w+)\["(?P<name>(?:[^"\\]|\\.)*)"\]\.?(?P<path>.+)', re.DOTALL)


def control_at(scene_rig: SceneRig, full_data_path: str) -> str:
    """Return the name of the control at a full data path, as Blender's operator Copy Full Data Path writes it.

    Args:
        full_data_path: for example `bpy.data.objects["arm"].data.shape_keys.key_blocks["smile"].value`.

    Returns:
        The name of a shape key, or OWNER/PATH; the text itself if it is not the path of a number of the rig.
    """
    match = _FULL_DATA_PATH.fullmatch(full_data_path.strip())
    collection = getattr(bpy.data, match["collection"], None) if match else None
    if not isinstance(collection, bpy.types.bpy_prop_collection):
        return full_data_path
    datablock = collection.get(bpy.utils.unescape_identifier(match["name"]))
    if not is_number(datablock, match["path"]):
        return full_data_path
    struct_owner, path, _ = fcurve_target(datablock, match["path"])
    index = parent_and_name(datablock, match["path"])[2]
    owner = owner_name(scene_rig, struct_owner)
    shape_key = SHAPE_KEY_PATH.fullmatch(path) if owner == SHAPE_KEYS else None
    if shape_key:
        return bpy.utils.unescape_identifier(shape_key["name"])
    return f"{owner}/{path}{'' if index is None else f'[{index}]'}" if owner else full_data_path


def suggested_controls(scene_rig: SceneRig) -> list[str]:
    """Suggest the custom properties that no driver sets, and bone collections, as users list them."""
    mesh_object, armature_object = scene_rig.mesh_object, scene_rig.armature_object
    names = []
    for owner, datablock in ((ARMATURE_OBJECT, armature_object), (MESH_OBJECT, mesh_object)):
        names += [f"{owner}/{path}" for path in custom_properties(datablock, "")]
    for bone in armature_object.pose.bones:
        names += [f"{ARMATURE_OBJECT}/{path}" for path in custom_properties(armature_object, bone.path_from_id())]
    return [*names, *(f"collection:{collection.name}" for collection in armature_object.data.collections_all)]


def control_default(scene_rig: SceneRig, name: str) -> float:
    """Return the default value of a control; 0 for a shape key."""
    owner, _, path = name.partition("/")
    transform = bone_transform(path)
    if transform is not None and transform.is_matrix:
        return float(transform.element[0] == transform.element[1])
    struct, attribute, index = parent_and_name(owner_of(scene_rig, owner), path)
    if isinstance(struct, bpy.types.ShapeKey):
        return 0.0
    if is_custom_property(attribute):
        key = custom_property_key(attribute)
        default = False if isinstance(struct[key], bool) else struct.id_properties_ui(key).as_dict()["default"]
        return float(default[index] if hasattr(default, "__len__") else default)
    prop = struct.bl_rna.properties[attribute]
    return float(prop.default if index is None else prop.default_array[index])
