# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads what deforms a mesh beside its skin weights (`core.deformation`), as a model will stand in for it."""

import json
from collections.abc import Iterator

import bpy

from ..core.rig import Fingerprint
from ..scene.arrays import COORDINATE, read
from ..scene.compatibility import node_input
from ..scene.controls import owner_name
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import animated_paths
from .modifier_stack import BIND_PROPERTIES, is_fdda_modifier, recorded_modifiers

_OF_ALL = frozenset(bpy.types.Modifier.bl_rna.properties.keys())
"""Properties that every modifier has; none of them says what it does to a mesh."""
_OF_SHAPE_KEY = ("value", "mute", "vertex_group", "interpolation")
_NOT_SHAPE = {"bbone_x", "bbone_z"}
"""How thick B-Bones are drawn."""
_DIGITS = 6


def read_deformation(scene_rig: SceneRig) -> dict:
    """Read what deforms the mesh of a rig.

    Raises:
        RigError: as `recorded_modifiers`.
    """
    mesh_object = scene_rig.mesh_object
    found = {
        "modifiers": [_modifier(scene_rig, modifier) for modifier in recorded_modifiers(mesh_object)],
        "shape_keys": _shape_keys(mesh_object),
        "b_bones": read_b_bones(scene_rig.armature_object.data),
        "drivers": _drivers(scene_rig),
    }
    return {key: value for key, value in found.items() if value or key == "modifiers"}


def read_b_bones(armature: bpy.types.Armature) -> dict:
    """Settings of the deforming bones that have B-Bone segments, by name."""
    known = [prop.identifier for prop in bpy.types.Bone.bl_rna.properties]
    names = [name for name in known if name.startswith("bbone_") and name not in _NOT_SHAPE]
    return {
        bone.name: {name.removeprefix("bbone_"): _value(None, bone, name) for name in names}
        for bone in armature.bones
        if bone.use_deform and bone.bbone_segments > 1
    }


def _modifier(scene_rig: SceneRig, modifier: bpy.types.Modifier) -> dict:
    if modifier.type == "NODES":
        settings = _node_inputs(modifier)
    else:
        properties = [p for p in modifier.bl_rna.properties if p.identifier not in _OF_ALL]
        bound = BIND_PROPERTIES.get(modifier.type)
        names = [p.identifier for p in properties if not p.is_readonly or p.identifier == bound]
        settings = {name: _value(scene_rig, modifier, name) for name in names if _is_setting(modifier, name)}
    animated = animated_paths(modifier.id_data)
    for name in settings:
        if f"{modifier.path_from_id()}.{name}" in animated:
            settings[name] = None
    return {"name": modifier.name, "type": modifier.type, "settings": settings}


def _is_setting(struct: bpy.types.bpy_struct, name: str) -> bool:
    prop = struct.bl_rna.properties[name]
    if prop.type == "POINTER":
        return issubclass(getattr(bpy.types, prop.fixed_type.identifier, object), bpy.types.ID)
    return prop.type != "COLLECTION"


def _node_inputs(modifier: bpy.types.NodesModifier) -> dict:
    group = modifier.node_group
    items = [] if group is None else group.interface.items_tree
    sockets = [i.identifier for i in items if i.item_type == "SOCKET" and i.in_out == "INPUT"]
    values = {socket: node_input(modifier, socket) for socket in sockets}
    return {socket: _plain(None, value) for socket, value in values.items() if value is not None}


def _shape_keys(mesh_object: bpy.types.Object) -> dict:
    """Settings of the shape keys that move vertices, by name."""
    keys = mesh_object.data.shape_keys
    if keys is None:
        return {}
    animated, relatives, found = animated_paths(keys), {}, {}
    for block in keys.key_blocks:
        if block == keys.reference_key:
            continue
        shape = read(block.data, COORDINATE)
        relative = block.relative_key
        if relative.name not in relatives:
            relatives[relative.name] = read(relative.data, COORDINATE)
        if (shape == relatives[relative.name]).all():
            # It moves nothing.
            continue
        settings = {name: _value(None, block, name) for name in _OF_SHAPE_KEY}
        for name in settings:
            if f"{block.path_from_id()}.{name}" in animated:
                settings[name] = None
        if mesh_object.show_only_shape_key:
            settings["value"] = float(block == mesh_object.active_shape_key)
        found[block.name] = settings | {"shape": Fingerprint.digest(shape)}
    return found


def _drivers(scene_rig: SceneRig) -> str:
    """A hash of the drivers of the mesh, its shape keys and its modifiers; empty when there are none."""
    mesh_object = scene_rig.mesh_object
    found = []
    for owner in (mesh_object, mesh_object.data, mesh_object.data.shape_keys):
        for curve in owner.animation_data.drivers if owner is not None and owner.animation_data else ():
            if owner is not mesh_object or _is_of_deformation(mesh_object, curve.data_path):
                found.append(_driver(scene_rig, curve))
    return Fingerprint.digest_text(json.dumps(sorted(found))) if found else ""


def _is_of_deformation(mesh_object: bpy.types.Object, path: str) -> bool:
    playback = [modifier.path_from_id() for modifier in mesh_object.modifiers if is_fdda_modifier(modifier)]
    return path.startswith("modifiers[") and not any(path.startswith(f"{own}.") for own in playback)


def _driver(scene_rig: SceneRig, curve: bpy.types.FCurve) -> list:
    driver = curve.driver
    return [
        *(curve.data_path, curve.array_index, curve.mute, driver.type),
        driver.expression if driver.type == "SCRIPTED" else "",
        [[_rounded(part) for part in point.co] for point in curve.keyframe_points],
        [list(map(_rounded, m.coefficients)) for m in curve.modifiers if m.type == "GENERATOR"],
        [
            [variable.name, variable.type, *(list(_target(scene_rig, variable, t)) for t in variable.targets)]
            for variable in driver.variables
        ],
    ]


def _target(scene_rig: SceneRig, variable: bpy.types.DriverVariable, target: bpy.types.DriverTarget) -> Iterator[str]:
    # Names of other objects are not compared: a character that is duplicated has others.
    owner = "" if target.id is None else owner_name(scene_rig, target.id)
    yield owner.partition(":")[0]
    if variable.type == "SINGLE_PROP":
        yield target.data_path
    else:
        yield from (target.bone_target, target.transform_type, target.transform_space, target.rotation_mode)


def _value(scene_rig: SceneRig | None, struct: bpy.types.bpy_struct, name: str) -> object:
    return _plain(scene_rig, getattr(struct, name))


def _plain(scene_rig: SceneRig | None, value: object) -> object:
    """A value of a property as JSON has it. Of a datablock, which may have another name, only what it is."""
    if value is None:
        return ""
    if isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return _rounded(value)
    if isinstance(value, bpy.types.Object):
        return "the rig's armature" if scene_rig and value == scene_rig.armature_object else value.type
    if isinstance(value, bpy.types.ID):
        return value.id_type
    if isinstance(value, bpy.types.bpy_struct):
        return getattr(value, "name", "")
    if isinstance(value, set):
        return sorted(value)
    return [_plain(None, part) for part in value]


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
