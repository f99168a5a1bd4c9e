# SPDX-License-Identifier: GPL-3.0-or-later
"""Several meshes on one armature: whether, and how, they can be recorded together."""

from collections.abc import Sequence
from dataclasses import replace

import bpy

from ..core.errors import RigError
from ..rig.dependencies import deforming_mesh_objects
from ..rig.modifier_stack import read_stack
from ..scene.scene_rig import SceneRig
from .plan import RecordingSettings, listed_controls


def common_armature(rigs: Sequence[SceneRig]) -> bpy.types.Object:
    """The armature object of all meshes.

    Raises:
        RigError: they follow different ones.
    """
    armature_object = rigs[0].armature_object
    for other in rigs:
        if other.armature_object != armature_object:
            raise RigError(
                f"'{rigs[0].mesh_object.name}' follows the armature '{armature_object.name}' and "
                f"'{other.mesh_object.name}' follows '{other.armature_object.name}'; record the meshes of each "
                "armature by themselves, with --object."
            )
    return armature_object


def controls_of_each(rigs: Sequence[SceneRig], settings: RecordingSettings) -> list[tuple[str, ...]]:
    """Which of the controls that settings list each mesh has.

    Raises:
        RigError: none of them has one.
    """
    found: list[list[str]] = [[] for _ in rigs]
    for text in settings.controls:
        errors = []
        for scene_rig, own in zip(rigs, found, strict=True):
            try:
                listed_controls(scene_rig, replace(settings, controls=(text,)))
                own.append(text)
            except RigError as error:
                errors.append(error)
        if len(errors) == len(rigs):
            raise errors[0]
    return [tuple(own) for own in found]


def in_passes(rigs: Sequence[SceneRig]) -> list[list[int]]:
    """Which meshes can be evaluated together, by their numbers.

    Modifiers that stay live are off while their mesh is evaluated. Where another mesh reads it with them, as a sleeve
    that clings to a subdivided body, it is evaluated in a pass of its own.
    """
    read = {mesh_object for scene_rig in rigs for mesh_object in deforming_mesh_objects(scene_rig)}
    alone = [n for n, rig in enumerate(rigs) if rig.mesh_object in read and read_stack(rig.mesh_object).downstream]
    together = [n for n in range(len(rigs)) if n not in alone]
    return [numbers for numbers in (together, *([n] for n in alone)) if numbers]
