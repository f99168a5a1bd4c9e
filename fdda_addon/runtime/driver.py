# SPDX-License-Identifier: GPL-3.0-or-later
"""The driver that runs models inside Blender's dependency graph.

Blender evaluates a driver after everything that its variables read. The first variable reads `Object.fdda_playback`,
whose getter runs the model (`playback.on_evaluate`). The driver sits on the position buffer, so Blender evaluates it
before the modifier that reads the positions.
"""

from collections.abc import Iterable

import bpy

from ..core.controls import Control
from ..scene.controls import owner_of
from ..scene.scene_rig import SceneRig

PLAYBACK_PROPERTY = "fdda_playback"
"""The property of `bpy.types.Object` whose getter runs the model."""
DriverInput = tuple[str, bpy.types.ID | None, str]
"""A driver variable: its type, the datablock that it reads, and a data path or the name of a bone."""


def playback_input(driven: bpy.types.Object) -> DriverInput:
    """Return the variable that runs the models of an object; it has to be the first variable."""
    return "SINGLE_PROP", driven, PLAYBACK_PROPERTY


def pose_inputs(buffer: bpy.types.Object, scene_rig: SceneRig, controls: Iterable[Control]) -> list[DriverInput]:
    """Return the variables whose datablocks a player reads (`evaluated_inputs`).

    Args:
        buffer: the position buffer.
        scene_rig: the rig whose pose is read.
        controls: the controls of the model.
    """
    return [
        # Evaluating the buffer's own geometry resets it to the stored positions, so that has to come first.
        ("SINGLE_PROP", buffer, "data.vertices[0].co[0]"),
        ("TRANSFORMS", scene_rig.mesh_object, ""),
        ("TRANSFORMS", scene_rig.armature_object, ""),
        *(("SINGLE_PROP", owner_of(scene_rig, control.owner), control.path) for control in controls),
    ]


def dependency_inputs(scene_rig: SceneRig, joint_names: Iterable[str]) -> list[DriverInput]:
    """Return the variables that only add dependencies: mode, strength, and the joints of the model.

    Blender evaluates a bone after its parents, so the last bone of each chain is enough.
    """
    bones = scene_rig.armature_object.data.bones
    # The pose reader reports missing joints.
    present = [name for name in joint_names if name in bones]
    parents = {bone.name for name in present for bone in bones[name].parent_recursive}
    return [
        ("SINGLE_PROP", scene_rig.mesh_object, "fdda.mode"),
        ("SINGLE_PROP", scene_rig.mesh_object, "fdda.strength"),
        *(("TRANSFORMS", scene_rig.armature_object, name) for name in present if name not in parents),
    ]


def set_driver_inputs(driven: bpy.types.Object, inputs: list[DriverInput]) -> None:
    """Make Blender evaluate an object after its inputs, whenever one of them changes."""
    if [_read_variable(variable) for variable in _driver_variables(driven)] == inputs:
        return
    driven.driver_remove("location", 0)
    # The location of the object is not visible. Unlike an expression, a sum is evaluated where scripts may not run.
    curve = driven.driver_add("location", 0)
    curve.driver.type = "SUM"
    for index, driver_input in enumerate(inputs):
        _write_variable(curve.driver.variables.new(), f"v{index}", driver_input)


def evaluated_inputs(driven: bpy.types.Object, count: int) -> list[bpy.types.ID | None]:
    """Return the evaluated datablocks of the first `count` variables after the playback property.

    Args:
        driven: the evaluated object with the driver.
        count: number of variables.
    """
    variables = driven.animation_data.drivers[0].driver.variables
    return [variable.targets[0].id for variable in variables[1 : 1 + count]]


def _driver_variables(driven: bpy.types.Object) -> list[bpy.types.DriverVariable]:
    drivers = driven.animation_data.drivers if driven.animation_data else ()
    return list(drivers[0].driver.variables) if len(drivers) else []


def _read_variable(variable: bpy.types.DriverVariable) -> DriverInput:
    target = variable.targets[0]
    return variable.type, target.id, target.data_path if variable.type == "SINGLE_PROP" else target.bone_target


def _write_variable(variable: bpy.types.DriverVariable, name: str, driver_input: DriverInput) -> None:
    variable_type, datablock, path = driver_input
    variable.name, variable.type = name, variable_type
    target = variable.targets[0]
    if variable_type == "TRANSFORMS":
        target.id, target.bone_target = datablock, path
        return
    # Without a fallback, a driver that was invalid once stays invalid.
    target.use_fallback_value = True
    target.id_type = datablock.id_type
    target.id, target.data_path = datablock, path
