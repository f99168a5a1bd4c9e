# SPDX-License-Identifier: GPL-3.0-or-later
"""The driver that runs models inside Blender's dependency graph.

Blender evaluates a driver after everything that its variables read. The first variable reads `Object.fdda_playback`,
whose getter runs the model (`playback.on_evaluate`). The driver belongs to the position buffer, so Blender evaluates it
before the modifier that reads the positions.
"""

from collections.abc import Iterable

import bpy

from ..core.controls import Control
from ..scene.controls import owner_of
from ..scene.scene_rig import SceneRig
from ..scene.unkeyed_changes import keep_unkeyed_changes

PLAYBACK_PROPERTY = "fdda_playback"
"""The property of `bpy.types.Object` whose getter runs the model."""
DriverInput = tuple[str, bpy.types.ID | None, str]
"""A driver variable: its type, the datablock that it reads, and a data path or the name of a bone."""


def playback_input(driven_object: bpy.types.Object) -> DriverInput:
    """Return the variable that runs the models of an object. It has to be the first variable of the driver."""
    return "SINGLE_PROP", driven_object, PLAYBACK_PROPERTY


def pose_inputs(scene_rig: SceneRig, controls: Iterable[Control]) -> list[DriverInput]:
    """Return the variables whose datablocks hold the pose (`evaluated_inputs`).

    Args:
        scene_rig: the rig whose pose is read.
        controls: controls on which all controls of the model depend (`ControlReader.sources`).
    """
    return [
        ("TRANSFORMS", scene_rig.armature_object, ""),
        *(("SINGLE_PROP", owner_of(scene_rig, control.owner), control.path) for control in controls),
    ]


def buffer_inputs(buffer: bpy.types.Object, mesh_object: bpy.types.Object) -> list[DriverInput]:
    """Return the variables of a position buffer and its bound object."""
    return [
        # Evaluating the geometry of the buffer resets its positions to the stored ones, so it has to come first.
        ("SINGLE_PROP", buffer, "data.vertices[0].co[0]"),
        ("TRANSFORMS", mesh_object, ""),
    ]


def setting_inputs(mesh_object: bpy.types.Object) -> list[DriverInput]:
    """Return the variables that only add a dependency on mode and strength of a bound object."""
    return [("SINGLE_PROP", mesh_object, "fdda.mode"), ("SINGLE_PROP", mesh_object, "fdda.strength")]


def joint_inputs(scene_rig: SceneRig, joint_names: Iterable[str]) -> list[DriverInput]:
    """Return the variables that only add dependencies on the joints of a model.

    Blender evaluates a bone after its parents, so the last bone of each chain is enough.
    """
    bones = scene_rig.armature_object.data.bones
    # The pose reader reports missing joints.
    bone_names = [name for name in joint_names if name in bones]
    parent_names = {bone.name for name in bone_names for bone in bones[name].parent_recursive}
    return [("TRANSFORMS", scene_rig.armature_object, name) for name in bone_names if name not in parent_names]


def set_driver_inputs(driven_object: bpy.types.Object, inputs: list[DriverInput]) -> None:
    """Make Blender evaluate an object after its inputs, whenever one of them changes."""
    curves = driven_object.animation_data.drivers[:1] if driven_object.animation_data else ()
    if [_read_variable(variable) for curve in curves for variable in curve.driver.variables] == inputs:
        return
    driven_object.driver_remove("location", 0)
    # The object is never shown, so its location is free for a driver. Unlike a scripted expression, a sum is evaluated
    # even if the user has disabled scripts.
    driver_curve = driven_object.driver_add("location", 0)
    driver_curve.driver.type = "SUM"
    for index, driver_input in enumerate(inputs):
        _write_variable(driver_curve.driver.variables.new(), f"v{index}", driver_input)
    keep_unkeyed_changes()


def evaluated_inputs(driven_object: bpy.types.Object, input_count: int) -> list[bpy.types.ID | None]:
    """Return the evaluated datablocks of the variables that follow the playback property.

    Args:
        driven_object: the evaluated object with the driver.
        input_count: number of these variables.
    """
    variables = driven_object.animation_data.drivers[0].driver.variables
    return [variable.targets[0].id for variable in variables[1 : 1 + input_count]]


def _read_variable(variable: bpy.types.DriverVariable) -> DriverInput:
    driver_target = variable.targets[0]
    path_or_bone = driver_target.data_path if variable.type == "SINGLE_PROP" else driver_target.bone_target
    return variable.type, driver_target.id, path_or_bone


def _write_variable(variable: bpy.types.DriverVariable, name: str, driver_input: DriverInput) -> None:
    variable_type, datablock, path_or_bone = driver_input
    variable.name, variable.type = name, variable_type
    driver_target = variable.targets[0]
    if variable_type == "TRANSFORMS":
        driver_target.id, driver_target.bone_target = datablock, path_or_bone
        return
    # Without a fallback, a driver that was invalid once stays invalid.
    driver_target.use_fallback_value = True
    driver_target.id_type = datablock.id_type
    driver_target.id, driver_target.data_path = datablock, path_or_bone
