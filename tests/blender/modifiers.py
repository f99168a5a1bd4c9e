# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters with a modifier more, and the smallest recording of them."""

from collections.abc import Callable

import bpy

from blend_fixtures.characters import stacks
from blend_fixtures.characters.base import tube
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from .conftest import ELBOW

FEW = RecordingSettings(poses=4, influence_poses=1)


def character(build: Callable[[], object] = tube) -> SceneRig:
    """Build a character in the empty scene."""
    build()
    return find_rig(ELBOW)


def at(place: int, kind: str, **settings: object) -> Callable[[bpy.types.Object], None]:
    def add(mesh_object: bpy.types.Object) -> None:
        modifier = mesh_object.modifiers.new("It", kind)
        for name, value in settings.items():
            setattr(modifier, name, value)
        mesh_object.modifiers.move(len(mesh_object.modifiers) - 1, place)

    return add


def nodes_at(place: int, *kinds: str) -> Callable[[bpy.types.Object], None]:
    def add(mesh_object: bpy.types.Object) -> None:
        at(place, "NODES", node_group=stacks.chain("Group", *kinds))(mesh_object)

    return add
