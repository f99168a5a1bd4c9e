# SPDX-License-Identifier: GPL-3.0-or-later
"""Recording of several meshes on one armature together."""

from collections.abc import Sequence
from dataclasses import replace

import bpy

from ..core.errors import RigError
from ..rig.dependencies import deforming_mesh_objects
from ..rig.modifier_stack import read_stack
from ..scene.scene_rig import SceneRig
from .plan import RecordingSettings, listed_controls


def common_armature(rigs: Sequence[SceneRig]) -> bpy.types.Object:
    """Return the armature object of all meshes.

    Raises:
        RigError: the meshes follow different armatures.
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


def split_controls(rigs: Sequence[SceneRig], settings: RecordingSettings) -> list[tuple[str, ...]]:
    """Return the controls of the settings that each mesh has.

    Raises:
        RigError: no mesh has a control.
    """
    controls_by_mesh: list[list[str]] = [[] for _ in rigs]
    for text in settings.controls:
        errors = []
        for scene_rig, mesh_controls in zip(rigs, controls_by_mesh, strict=True):
            try:
                listed_controls(scene_rig, replace(settings, controls=(text,)))
                mesh_controls.append(text)
            except RigError as error:
                errors.append(error)
        if len(errors) == len(rigs):
            raise errors[0]
    return [tuple(mesh_controls) for mesh_controls in controls_by_mesh]


def group_into_passes(rigs: Sequence[SceneRig]) -> list[list[int]]:
    """Group the indices of meshes that can be evaluated together.

    Modifiers after the last deforming one are disabled while their mesh is evaluated. A mesh that another mesh reads
    with these modifiers, such as a subdivided body under a shrinkwrapped sleeve, gets a pass of its own.
    """
    read = {mesh_object for scene_rig in rigs for mesh_object in deforming_mesh_objects(scene_rig)}
    separate = [n for n, rig in enumerate(rigs) if rig.mesh_object in read and read_stack(rig.mesh_object).downstream]
    together = [n for n in range(len(rigs)) if n not in separate]
    return [numbers for numbers in (together, *([n] for n in separate)) if numbers]
