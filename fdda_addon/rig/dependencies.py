# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the bones and numbers that drivers and modifiers of meshes read, so that the meshes depend on them.

The values of their shape keys are inputs of a model, so bones and numbers that act through these alone are no inputs.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import bpy

from ..core.controls import EVALUATION_TIME, SHAPE_KEYS, Control
from ..core.errors import RigError
from ..scene.action_slots import CurvesByDatablock, curves_of_actions
from ..scene.animation import changes_value, curves_with_actions
from ..scene.controls import canonical_path, driven_numbers, make_control, owner_name
from ..scene.scene_rig import SceneRig
from .other_armatures import controls_of_other_armatures
from .sources import Sources


@dataclass(frozen=True)
class Dependencies:
    """Bones and controls on which the meshes of a rig depend besides their skin weights.

    Attributes:
        bones: names of bones of the armature that their drivers read, or that move objects their modifiers read.
        controls: values of their shape keys, numbers that other drivers read, and keyed shape keys of other objects,
            with the ranges of their properties.
        key_bones, key_numbers: names of bones, and of controls, that act through the shape keys of the meshes alone.
    """

    bones: frozenset[str]
    controls: tuple[Control, ...]
    key_bones: frozenset[str] = frozenset()
    key_numbers: frozenset[str] = frozenset()


def read_dependencies(
    scene_rig: SceneRig, actions: Iterable[bpy.types.Action] = (), *, has_random_poses: bool = True
) -> Dependencies:
    """Find the bones and controls on which the meshes of a rig depend.

    Numbers without a range are left out; a user can list them.

    Args:
        scene_rig: the rig.
        actions: further actions that may be played.
        has_random_poses: random poses set the values of shape keys that have no driver. Without these, a value that no
            action keys never changes.
    """
    controls: dict[str, Control] = {}
    bones, all_bones, key_numbers = set(), set(), set()
    for mesh_object in scene_rig.mesh_objects:
        sources, all_sources = (
            Sources(scene_rig, mesh_object, follows_shape_keys=follows) for follows in (False, True)
        )
        curves_by_action = curves_of_actions(actions, mesh_object, scene_rig.armature_object)
        key_values = list(_key_values(scene_rig, mesh_object, curves_by_action, has_random_poses))
        other_names = *_driver_inputs(sources), *_keyed_shape_keys(sources, curves_by_action)
        for control in controls_of_other_armatures(scene_rig, sources):
            controls.setdefault(control.name, control)
        for name in (*key_values, *other_names):
            owner, _, path = name.partition("/")
            with suppress(RigError):
                control = make_control(scene_rig, owner, path)
                controls.setdefault(control.name, control)
        key_numbers |= {*_driver_inputs(all_sources)}
        key_numbers |= {control.name for control in controls_of_other_armatures(scene_rig, all_sources)}
        bones |= sources.rig_bones
        all_bones |= all_sources.rig_bones
    bones, all_bones = (
        frozenset(each).intersection(scene_rig.armature_object.data.bones.keys()) for each in (bones, all_bones)
    )
    return Dependencies(bones, tuple(controls.values()), all_bones - bones, frozenset(key_numbers - controls.keys()))


def _key_values(
    scene_rig: SceneRig,
    mesh_object: bpy.types.Object,
    curves_by_action: Sequence[CurvesByDatablock],
    has_random_poses: bool,
) -> Iterator[str]:
    """Yield the names of the controls that are values of the shape keys of one mesh, or their evaluation time."""
    shape_keys = mesh_object.data.shape_keys
    # While one key is shown alone, the values have no effect.
    if shape_keys is None or mesh_object.show_only_shape_key:
        return
    keyed_curves = curves_with_actions(shape_keys, curves_by_action)
    changing_paths = {canonical_path(shape_keys, curve.data_path) for curve in keyed_curves if changes_value(curve)}
    changing_paths |= {path for path, _ in driven_numbers(shape_keys)}
    if shape_keys.use_relative:
        blocks = [block for block in shape_keys.key_blocks if block != shape_keys.reference_key and not block.mute]
        paths = [f'key_blocks["{bpy.utils.escape_identifier(block.name)}"].value' for block in blocks]
    else:
        paths = [EVALUATION_TIME]
    owner = owner_name(scene_rig, shape_keys)
    yield from (f"{owner}/{path}" for path in paths if has_random_poses or path in changing_paths)


def deforming_mesh_objects(scene_rig: SceneRig, mesh_object: bpy.types.Object) -> list[bpy.types.Object]:
    """Find the other mesh objects that deform a mesh."""
    sources = Sources(SceneRig(mesh_object, scene_rig.armature_object), mesh_object).objects
    return [
        source_object
        for source_object, uses_geometry in list(sources.items())[1:]
        if uses_geometry and source_object.type == "MESH"
    ]


def _driver_inputs(sources: Sources) -> Iterator[str]:
    """Yield the names of the controls that drivers read."""
    for datablock, path in sources.numbers:
        if name := sources.control_name(datablock, path):
            yield name


def _keyed_shape_keys(sources: Sources, curves_by_action: Sequence[CurvesByDatablock]) -> Iterator[str]:
    """Yield the names of the controls that are values of keyed shape keys of other objects, such as a lattice."""
    for shape_keys, prefix in sources.datablocks.items():
        if not isinstance(shape_keys, bpy.types.Key) or prefix.startswith(SHAPE_KEYS):
            continue
        keyed_curves = curves_with_actions(shape_keys, curves_by_action)
        keyed_paths = {canonical_path(shape_keys, curve.data_path) for curve in keyed_curves if changes_value(curve)}
        for block in shape_keys.key_blocks:
            if (
                (path := block.path_from_id("value")) in keyed_paths
                and not block.mute
                and block != shape_keys.reference_key
            ):
                yield sources.control_name(shape_keys, path)
