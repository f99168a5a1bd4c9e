# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads how bones follow the others that deform a mesh and are no inputs of its model.

A model reads the poses of its joints, so whatever moves these may change: keys, constraints and their influences. If it
reads key joints, it has learned how the other deforming bones follow them. Its inputs do not show a change of that, so
it is compared (`core.deformation`).
"""

import json
from collections.abc import Iterable, Iterator
from functools import cache
from operator import attrgetter

import bpy
import numpy as np

from ..core.mathematics.key_joints import with_sources
from ..core.recording.bones import RecordedBones
from ..core.rig import Fingerprint, Rig
from ..scene.bone_transform import controls_by_bone
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import animated_paths
from .deformation import is_setting, json_value, read_driver, rounded
from .dependency_graph import DependencyGraph, Node
from .references import add_bones, add_drivers, ik_chain, split_bone_path

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
