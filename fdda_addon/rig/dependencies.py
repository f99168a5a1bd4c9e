# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the bones and numbers that drivers and modifiers of a mesh read, so that the mesh depends on them."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import bpy

from ..core.controls import Control
from ..core.errors import RigError
from ..scene.action_slots import CurvesByDatablock, curves_of_actions
from ..scene.animation import changes_value, curves_with_actions
from ..scene.controls import canonical_path, make_control
from ..scene.scene_rig import SceneRig
from .other_armatures import controls_of_other_armatures
from .sources import Sources


@dataclass(frozen=True)
class Dependencies:
    """Bones and controls on which a mesh depends besides its skin weights.

    Attributes:
        bones: names of bones of its armature that its drivers read, or that move objects that its modifiers read.
        controls: numbers that its drivers read, and keyed shape keys, with the ranges of their properties.
    """

    bones: frozenset[str]
    controls: tuple[Control, ...]


def read_dependencies(scene_rig: SceneRig, actions: Iterable[bpy.types.Action] = ()) -> Dependencies:
    """Find the bones and controls on which a mesh depends, except numbers without a range, which a user can list.

    Args:
        scene_rig: the rig.
        actions: further actions that may be played.
    """
    sources = Sources(scene_rig, scene_rig.mesh_object)
    curves_by_action = curves_of_actions(actions, scene_rig.mesh_object, scene_rig.armature_object)
    controls = {control.name: control for control in controls_of_other_armatures(scene_rig, sources)}
    for name in (*_driver_inputs(sources), *_keyed_shape_keys(sources, curves_by_action)):
        owner, _, path = name.partition("/")
        try:
            control = make_control(scene_rig, owner, path)
        except RigError:
            continue
        controls.setdefault(control.name, control)
    bones = scene_rig.armature_object.data.bones
    return Dependencies(frozenset(name for name in sources.rig_bones if name in bones), tuple(controls.values()))


def deforming_mesh_objects(scene_rig: SceneRig) -> list[bpy.types.Object]:
    """Find the other mesh objects that deform a mesh."""
    sources = Sources(scene_rig, scene_rig.mesh_object).objects
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
    """Yield the names of the controls that are values of keyed shape keys."""
    for shape_keys in (datablock for datablock in sources.datablocks if isinstance(datablock, bpy.types.Key)):
        keyed_curves = curves_with_actions(shape_keys, curves_by_action)
        keyed_paths = {canonical_path(shape_keys, curve.data_path) for curve in keyed_curves if changes_value(curve)}
        for block in shape_keys.key_blocks:
            if (
                (path := block.path_from_id("value")) in keyed_paths
                and not block.mute
                and block != shape_keys.reference_key
            ):
                yield sources.control_name(shape_keys, path)
