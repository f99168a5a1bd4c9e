# SPDX-License-Identifier: GPL-3.0-or-later
"""What deforms a mesh beside the weights of its bones: bones and numbers that its drivers and modifiers read."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import bpy

from ..core.controls import Control
from ..core.errors import RigError
from ..scene.animation import changes_value, curves_with_actions
from ..scene.controls import make_control
from ..scene.scene_rig import SceneRig
from .other_armatures import controls_of_other_armatures
from .sources import Sources


@dataclass(frozen=True)
class Dependencies:
    """What a mesh depends on.

    Attributes:
        bones: names of bones of its armature that its drivers read, or that move what its modifiers read.
        controls: numbers that its drivers read and shape keys that are keyed, with the ranges that their properties
            state.
    """

    bones: frozenset[str]
    controls: tuple[Control, ...]


def read_dependencies(scene_rig: SceneRig, actions: Iterable[bpy.types.Action] = ()) -> Dependencies:
    """Find what a mesh depends on; numbers that state no range are left out, a user can list them with one.

    Args:
        scene_rig: the rig.
        actions: whose keys count beside those that are active.
    """
    sources = Sources(scene_rig, scene_rig.mesh_object)
    controls = {control.name: control for control in controls_of_other_armatures(scene_rig, sources)}
    for name in (*_names_read(sources), *_keyed_shapes(sources, tuple(actions))):
        owner, _, path = name.partition("/")
        try:
            control = make_control(scene_rig, owner, path)
        except RigError:
            continue
        controls.setdefault(control.name, control)
    known = scene_rig.armature_object.data.bones
    return Dependencies(frozenset(name for name in sources.rig_bones if name in known), tuple(controls.values()))


def deforming_mesh_objects(scene_rig: SceneRig) -> list[bpy.types.Object]:
    """The other mesh objects that deform a mesh."""
    objects = Sources(scene_rig, scene_rig.mesh_object).objects
    return [found for found, with_shape in list(objects.items())[1:] if with_shape and found.type == "MESH"]


def _names_read(sources: Sources) -> Iterator[str]:
    for datablock, path in sources.numbers:
        if name := sources.name_of(datablock, path):
            yield name


def _keyed_shapes(sources: Sources, actions: tuple[bpy.types.Action, ...]) -> Iterator[str]:
    """Values of shape keys that F-curves animate."""
    for keys in (found for found in sources.datablocks if isinstance(found, bpy.types.Key)):
        keyed = {curve.data_path for curve in curves_with_actions(keys, actions) if changes_value(curve)}
        for block in keys.key_blocks:
            if (path := block.path_from_id("value")) in keyed and not block.mute and block != keys.reference_key:
                yield sources.name_of(keys, path)
