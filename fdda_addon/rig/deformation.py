# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the modifiers, shape keys and drivers that deform a mesh besides its skin weights (`core.deformation`).

A model of key joints has learned how the other deforming bones follow these. Its inputs do not show a change of that,
so what moves these bones is read, too.
"""

import json
from collections.abc import Iterable, Iterator
from functools import cache
from operator import attrgetter

import bpy
import numpy as np

from ..core.controls import MESH_OBJECT, SHAPE_KEYS
from ..core.deformation import versionless_path
from ..core.mathematics.key_joints import with_sources
from ..core.recording.index import RecordedBones
from ..core.rig import Fingerprint, Rig
from ..scene.compatibility import node_input_settings
from ..scene.controls import controls_by_bone, owner_name
from ..scene.mesh import vertex_layers
from ..scene.node_groups import read_texts
from ..scene.scene_rig import SceneRig, armature_of
from ..scene.temporary_state import animated_paths
from .modifier_stack import BIND_PROPERTIES, is_fdda_modifier, recorded_modifiers
from .references import DependencyGraph, Node, add_bones, add_drivers, ik_chain, split_bone_path
from .shape_keys import key_positions
from .sources import is_shape_key_value

_COMMON_PROPERTIES = frozenset(bpy.types.Modifier.bl_rna.properties.keys())
"""Properties that all modifiers have; none of them changes the effect on the mesh."""
_SHAPE_KEY_PROPERTIES = ("value", "mute", "vertex_group", "interpolation")
_DISPLAY_PROPERTIES = {"bbone_x", "bbone_z"}
"""Display size of B-Bones."""
_B_BONE_SETTINGS = tuple(
    name
    for name, _property in bpy.types.Bone.bl_rna.properties.items()
    if name.startswith("bbone_") and name not in _DISPLAY_PROPERTIES
)
_read_b_bone = attrgetter(*_B_BONE_SETTINGS)
_PLAIN_TYPES = frozenset({bool, int, float, str})
_SIGNIFICANT_DIGITS = 6


def read_deformation(scene_rig: SceneRig) -> dict:
    """Read the modifiers, shape keys, B-Bones and drivers that deform the mesh of a rig, as JSON values."""
    mesh_object = scene_rig.mesh_object
    deformation = {
        **read_modifiers_and_drivers(scene_rig),
        "shape_keys": _read_shape_keys(mesh_object),
        "b_bones": read_b_bones(scene_rig.armature_object.data),
    }
    settings = [entry["settings"] for entry in deformation["modifiers"]] + list(deformation["shape_keys"].values())
    texts = {value for values in settings for value in values.values() if isinstance(value, str)}
    for modifier in recorded_modifiers(mesh_object):
        texts.update(read_texts(getattr(modifier, "node_group", None)))
    layers = vertex_layers(mesh_object, texts)
    deformation["attributes"] = {name: {"values": Fingerprint.digest(values)} for name, values in layers.items()}
    return {key: value for key, value in deformation.items() if value or key == "modifiers"}


def read_modifiers_and_drivers(scene_rig: SceneRig) -> dict:
    """Read the modifiers that deform the mesh of a rig, and digests of the drivers, as JSON values."""
    modifiers = [_read_modifier(scene_rig, modifier) for modifier in recorded_modifiers(scene_rig.mesh_object)]
    # A model reads the values of shape keys, so whatever drives these may change.
    mesh_object, drivers = scene_rig.mesh_object, {}
    fdda_paths = tuple(m.path_from_id() for m in mesh_object.modifiers if is_fdda_modifier(m))
    for owner in (mesh_object, mesh_object.data, mesh_object.data.shape_keys):
        for curve in owner.animation_data.drivers if owner is not None and owner.animation_data else ():
            path = curve.data_path
            is_rig = owner is not mesh_object or (path.startswith("modifiers[") and not path.startswith(fdda_paths))
            if is_rig and not curve.mute and not is_shape_key_value(mesh_object, owner, curve.data_path):
                name = (
                    f"{owner_name(scene_rig, owner) or 'mesh'}/{versionless_path(curve.data_path)}[{curve.array_index}]"
                )
                drivers[name] = Fingerprint.digest_text(json.dumps(read_driver(scene_rig, curve)))
    return {"modifiers": modifiers, "drivers": drivers}


def read_b_bones(armature: bpy.types.Armature) -> dict:
    """Read the settings of the deforming bones that have B-Bone segments, by name; animated settings are None."""
    return {
        bone_name: {
            name.removeprefix("bbone_"): None if value is None else json_value(None, value)
            for name, value in zip(_B_BONE_SETTINGS, values, strict=True)
        }
        for bone_name, values in b_bone_values(armature, armature.bones).items()
    }


def b_bone_values(armature: bpy.types.Armature, bones: Iterable[bpy.types.Bone]) -> dict[str, tuple]:
    """Read what `read_b_bones` reads, quickly and without rounding: a value for each of `_B_BONE_SETTINGS`."""
    # Rigify drives the easing: Blender writes the value of the current pose into the bone.
    animated: dict[str, set[str]] = {}
    for path in animated_paths(armature):
        bone_path, _, name = path.rpartition(".")
        animated.setdefault(bone_path, set()).add(name)
    values_by_bone = {}
    for bone in bones:
        if bone.use_deform and bone.bbone_segments > 1:
            values = tuple(map(_copy, _read_b_bone(bone)))
            if names := animated.get(bone.path_from_id()) if animated else None:
                values = tuple(None if n in names else v for n, v in zip(_B_BONE_SETTINGS, values, strict=True))
            values_by_bone[bone.name] = values
    return values_by_bone


def _copy(value: object) -> object:
    """Copy the value of a property if it refers to Blender's data: the elements of an array, or the name of a bone."""
    if type(value) in _PLAIN_TYPES:
        return value
    return tuple(value) if hasattr(value, "__len__") else getattr(value, "name", "")


def _read_modifier(scene_rig: SceneRig, modifier: bpy.types.Modifier) -> dict:
    """Read name, type and settings of a modifier; animated settings are None."""
    if modifier.type == "NODES":
        settings = node_input_settings(modifier)
    else:
        properties = [p for p in modifier.bl_rna.properties if p.identifier not in _COMMON_PROPERTIES]
        bind_property = BIND_PROPERTIES.get(modifier.type)
        setting_names = [p.identifier for p in properties if not p.is_readonly or p.identifier == bind_property]
        path = modifier.path_from_id()
        settings = {
            name: (f"{path}.{name}", getattr(modifier, name)) for name in setting_names if is_setting(modifier, name)
        }
    animated = animated_paths(modifier.id_data)
    values = {
        name: None if path in animated else json_value(scene_rig, value) for name, (path, value) in settings.items()
    }
    return {"name": modifier.name, "type": modifier.type, "settings": values}


def is_setting(struct: bpy.types.bpy_struct, name: str) -> bool:
    """Return whether a property holds a value or a datablock, not a nested struct or a collection."""
    prop = struct.bl_rna.properties[name]
    if prop.type == "POINTER":
        return issubclass(getattr(bpy.types, prop.fixed_type.identifier, object), bpy.types.ID)
    return prop.type != "COLLECTION"


def _read_shape_keys(mesh_object: bpy.types.Object) -> dict:
    """Read the settings of the shape keys that move vertices, by name; animated settings are None."""
    key_datablock = mesh_object.data.shape_keys
    if key_datablock is None:
        return {}
    animated, shape_keys = animated_paths(key_datablock), {}
    for block, positions, relative_positions in key_positions(key_datablock):
        if (positions == relative_positions).all():
            # The key moves no vertex.
            continue
        settings = {name: json_value(None, getattr(block, name)) for name in _SHAPE_KEY_PROPERTIES}
        for name in settings:
            if f"{block.path_from_id()}.{name}" in animated:
                settings[name] = None
        settings |= {
            "relative_key": block.relative_key.name,
            "use_relative": key_datablock.use_relative,
            "show_only_shape_key": mesh_object.show_only_shape_key,
        }
        if not key_datablock.use_relative:
            settings["frame"] = rounded(block.frame)
        if mesh_object.show_only_shape_key:
            settings["value"] = float(block == mesh_object.active_shape_key)
        shape_keys[block.name] = settings | {"shape": Fingerprint.digest(positions)}
    return shape_keys


def read_driver(scene_rig: SceneRig, curve: bpy.types.FCurve) -> list:
    driver = curve.driver
    return [
        *(versionless_path(curve.data_path), curve.array_index, curve.mute, driver.type),
        driver.expression if driver.type == "SCRIPTED" else "",
        [[rounded(coordinate) for coordinate in point.co] for point in curve.keyframe_points],
        [list(map(rounded, modifier.coefficients)) for modifier in curve.modifiers if modifier.type == "GENERATOR"],
        [
            [
                variable.name,
                variable.type,
                *(list(_read_target(scene_rig, variable, target)) for target in variable.targets),
            ]
            for variable in driver.variables
        ],
    ]


def _read_target(
    scene_rig: SceneRig, variable: bpy.types.DriverVariable, target: bpy.types.DriverTarget
) -> Iterator[str]:
    # Leave out the names of objects, because they differ in a duplicate of the character, and which of the character's
    # meshes is read, because each may be read first.
    if isinstance(target.id, bpy.types.Key):
        yield SHAPE_KEYS
    elif getattr(target.id, "type", "") == "MESH" and armature_of(target.id) == scene_rig.armature_object:
        yield MESH_OBJECT
    else:
        yield owner_name(scene_rig, target.id).partition(":")[0]
    if variable.type == "SINGLE_PROP":
        yield target.data_path
    else:
        yield from (target.bone_target, target.transform_type, target.transform_space, target.rotation_mode)


def json_value(scene_rig: SceneRig | None, value: object) -> object:
    """Convert the value of a property to JSON; a datablock becomes its type alone, because its name may change."""
    if value is None:
        return ""
    if isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return rounded(value)
    if isinstance(value, bpy.types.Object):
        return "the rig's armature" if scene_rig and value == scene_rig.armature_object else value.type
    if isinstance(value, bpy.types.ID):
        return value.id_type
    if isinstance(value, bpy.types.bpy_struct):
        return getattr(value, "name", "")
    if isinstance(value, set):
        return sorted(value)
    return [json_value(None, item) for item in value]


def rounded(value: float) -> float:
    return float(f"{value:.{_SIGNIFICANT_DIGITS}g}")


_INHERITANCE = ("use_inherit_rotation", "inherit_scale", "use_local_location", "use_relative_parent")
_IK_PREFIXES = ("ik_", "lock_ik_", "use_ik_")
_CONSTRAINT_LABELS = {"name", "type", "show_expanded", "is_override_data", "active", "enabled", "mute", "influence"}
"""Properties of constraints that have no effect, or that are read on their own."""


def describe_bones(
    scene_rig: SceneRig, rig: Rig, dependencies: Iterable[str], fixed_joints: Iterable[str]
) -> RecordedBones:
    """Describe the bones of a rig, so that key joints can be chosen without Blender.

    Args:
        scene_rig, rig: the rig with its own skin weights and all joints and controls.
        dependencies: names of the joints that move the mesh otherwise than by skin weights.
        fixed_joints: names of the joints that keep their parents as reference joints.
    """
    sources, controlled = _sources_of_bones(scene_rig.armature_object), set(controls_by_bone(rig.controls))
    weighted = {rig.joint_names[joint] for joint in np.unique(rig.skin_joints[rig.skin_weights > 0])}
    described = sorted(with_sources(sources, {*rig.joint_names, *controlled}))
    indices = {name: index for index, name in enumerate(rig.joint_names)}
    return RecordedBones(
        tuple(sorted(indices[name] for name in dependencies if name in indices)),
        tuple(sorted(indices[name] for name in fixed_joints if name in indices)),
        tuple(sorted(controlled)),
        {name: sorted(sources[name] & sources.keys()) for name in described},
        read_unread_bones(scene_rig, sorted(with_sources(sources, weighted))),
    )


def read_unread_bones(scene_rig: SceneRig, names: Iterable[str]) -> dict[str, dict]:
    """Read rest pose, parent, constraints and drivers of bones, as JSON settings by name, without missing bones."""
    armature_object = scene_rig.armature_object
    animation, bones = armature_object.animation_data, armature_object.pose.bones
    drivers: dict[str, list] = {}
    for curve in animation.drivers if animation else ():
        bone_name, subpath = split_bone_path(armature_object, curve.data_path)
        if bone_name and not subpath.startswith('["'):
            drivers.setdefault(bone_name, []).append(curve)
    animated = animated_paths(armature_object)
    solved = {b for bone in bones for c in bone.constraints if not c.mute for b in ik_chain(bone, c)}
    return {
        name: _read_bone(scene_rig, bones[name], drivers.get(name, ()), animated, name in solved)
        for name in names
        if name in bones
    }


def _read_bone(
    scene_rig: SceneRig,
    pose_bone: bpy.types.PoseBone,
    drivers: Iterable[bpy.types.FCurve],
    animated: set[str],
    is_solved: bool,
) -> dict:
    """Read the settings of a bone, given its drivers, the animated paths, and whether it is part of an IK chain."""
    bone = pose_bone.bone
    rest, length = np.array(bone.matrix_local, np.float64)[:3], bone.length
    rest[:, 3] /= length or 1.0
    constraints, influences = [], []
    bone_path = f'pose.bones["{bpy.utils.escape_identifier(bone.name)}"].'
    for constraint in pose_bone.constraints:
        path = f'{bone_path}constraints["{bpy.utils.escape_identifier(constraint.name)}"]'
        is_animated = f"{path}.influence" in animated or f"{path}.mute" in animated
        if is_animated or (not constraint.mute and constraint.influence > 0):
            settings = list(_read_constraint(scene_rig, constraint, path, animated))
            constraints.append(f"{constraint.type} {Fingerprint.digest_text(json.dumps(settings))}")
            influences.append(None if is_animated else rounded(constraint.influence))
    settings = [json_value(scene_rig, getattr(bone, name, None)) for name in _INHERITANCE]
    if is_solved:
        names = [prop.identifier for prop in pose_bone.bl_rna.properties if prop.identifier.startswith(_IK_PREFIXES)]
        settings += [json_value(scene_rig, getattr(pose_bone, name)) for name in names]
    digests = [json.dumps(read_driver(scene_rig, curve)) for curve in drivers]
    return {
        "rest pose": [rounded(float(value)) for value in rest.ravel()],
        "length": rounded(length),
        "parent": bone.parent.name if bone.parent else "",
        "inheritance or IK": Fingerprint.digest_text(json.dumps(settings)),
        "constraints": constraints,
        "influences": influences,
        "drivers": Fingerprint.digest_text("".join(sorted(digests))) if digests else "",
    }


def _read_constraint(
    scene_rig: SceneRig, constraint: bpy.types.Constraint, path: str, animated: set[str]
) -> Iterator[list]:
    """Yield name and value of each setting of a constraint, and what its targets are."""
    names = _setting_names(constraint.bl_rna.identifier)
    for name, value in zip(names, attrgetter(*names)(constraint), strict=True):
        yield [name, None if f"{path}.{name}" in animated else json_value(scene_rig, value)]
    for index, target in enumerate(getattr(constraint, "targets", ())):
        weight = getattr(target, "weight", 1.0)
        is_animated = f"{path}.targets[{index}].weight" in animated
        yield [json_value(scene_rig, target.target), target.subtarget, None if is_animated else rounded(weight)]


@cache
def _setting_names(type_name: str) -> tuple[str, ...]:
    """Return the names of the settings of a type of constraint that have an effect."""
    rna_type = getattr(bpy.types, type_name)
    properties = [prop for prop in rna_type.bl_rna.properties if prop.identifier not in _CONSTRAINT_LABELS]
    return tuple(
        prop.identifier for prop in properties if not prop.is_readonly and is_setting(rna_type, prop.identifier)
    )


def _sources_of_bones(armature_object: bpy.types.Object) -> dict[str, set[str]]:
    """Return the bones of the same armature that each bone reads: parent, targets, IK chains, drivers and handles."""
    graph = DependencyGraph()
    add_bones(graph, armature_object, animated_paths(armature_object), only_transforms=True)
    for datablock in (armature_object, armature_object.data):
        add_drivers(graph, datablock)
    sources = {}
    for bone in armature_object.pose.bones:
        # A driver may read a property that another driver sets.
        needed, pending = set(), [Node(armature_object, bone.name)]
        while pending:
            new_nodes = graph.needs.get(pending.pop(), set()) - needed
            needed |= new_nodes
            pending += [node for node in new_nodes if node.driven_path]
        sources[bone.name] = {node.bone for node in needed if node.datablock == armature_object} - {"", bone.name}
    return sources
