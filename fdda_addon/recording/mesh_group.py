# SPDX-License-Identifier: GPL-3.0-or-later
"""Groups several meshes on one armature, whose recordings share the poses."""

from collections.abc import Sequence
from dataclasses import replace

from ..core.errors import RigError
from ..rig.dependencies import deforming_mesh_objects
from ..rig.modifier_stack import read_stack
from ..scene.scene_rig import SceneRig
from .plan import RecordingSettings, listed_controls


def check_common_armature(rigs: Sequence[SceneRig]) -> None:
    """Check that all meshes follow the same armature object.

    Raises:
        RigError: the meshes follow different armatures.
    """
    armature_object = rigs[0].armature_object
    for other_rig in rigs:
        if other_rig.armature_object != armature_object:
            raise RigError(
                f"'{rigs[0].mesh_object.name}' follows the armature '{armature_object.name}' and "
                f"'{other_rig.mesh_object.name}' follows '{other_rig.armature_object.name}'; record the meshes of each "
                "armature by themselves, with --object."
            )


def split_controls(rigs: Sequence[SceneRig], settings: RecordingSettings) -> list[tuple[str, ...]]:
    """Return for each mesh the controls of the settings that it has.

    Raises:
        RigError: there is a control that no mesh has.
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

    Downstream modifiers are disabled while a mesh is evaluated. But another mesh may read the mesh with these
    modifiers, as a shrinkwrapped sleeve reads a subdivided body. Such a mesh gets a pass of its own.
    """
    read_objects = {mesh_object for scene_rig in rigs for mesh_object in deforming_mesh_objects(scene_rig)}
    separate_indices = [
        index
        for index, rig in enumerate(rigs)
        if rig.mesh_object in read_objects and read_stack(rig.mesh_object).downstream
    ]
    common_indices = [index for index in range(len(rigs)) if index not in separate_indices]
    return [indices for indices in (common_indices, *([index] for index in separate_indices)) if indices]
