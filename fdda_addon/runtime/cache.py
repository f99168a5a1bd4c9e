# SPDX-License-Identifier: GPL-3.0-or-later
"""The cache object of a bound mesh: it holds the positions that a model gives, and its driver asks for them.

Blender evaluates the driver inside its dependency graph: after all that its variables name, before the modifier that
reads the positions. One variable reads the property `Object.fdda_playback`, whose getter runs the model (`playback`).

Object and mesh are runtime data, local, and in no scene: they are never saved, and are made anew when they are gone.
"""

from collections.abc import Iterable

import bpy

from ..core.controls import Control
from ..scene.controls import owner_of
from ..scene.mesh import mesh_positions, set_mesh_positions
from ..scene.scene_rig import MODIFIER_NAME, SceneRig

GETTER = "fdda_playback"
"""The property of `bpy.types.Object` whose getter runs the model."""
KEY = "fdda_cache"
"""Custom property of a cache object."""
Variable = tuple[str, bpy.types.ID | None, str]
"""What a variable of a driver reads: its kind, of which datablock, and a path or the name of a bone."""


def new_cache(mesh_object: bpy.types.Object) -> bpy.types.Object:
    """A cache object with the vertices of a mesh."""
    name = f"{mesh_object.name} {MODIFIER_NAME} positions"
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(mesh_object.data.vertices))
    set_mesh_positions(mesh, mesh_positions(mesh_object.data))
    cache = bpy.data.objects.new(name, mesh)
    mesh.is_runtime_data = cache.is_runtime_data = True
    cache[KEY] = True
    return cache


def is_cache(scene_object: bpy.types.Object) -> bool:
    """Whether an object is a cache object of this session."""
    return scene_object.is_runtime_data and KEY in scene_object


def remove(cache: bpy.types.Object | None) -> None:
    """Delete a cache object and its mesh."""
    if cache is not None and cache.library is None:
        mesh = cache.data
        bpy.data.objects.remove(cache)
        if mesh.users == 0:
            bpy.data.meshes.remove(mesh)


def sources_of(cache: bpy.types.Object, scene_rig: SceneRig, controls: Iterable[Control]) -> list[Variable]:
    """What a live binding reads when it plays (`sources`).

    Args:
        cache: the cache object.
        scene_rig: the rig that moves it.
        controls: of the model.
    """
    return [
        # When its own mesh is evaluated, the positions that are stored there come back.
        ("SINGLE_PROP", cache, "data.vertices[0].co[0]"),
        ("TRANSFORMS", scene_rig.mesh_object, ""),
        ("TRANSFORMS", scene_rig.armature_object, ""),
        *(("SINGLE_PROP", owner_of(scene_rig, control.owner), control.path) for control in controls),
    ]


def further_inputs(scene_rig: SceneRig, joints: Iterable[str]) -> list[Variable]:
    """What the positions follow from besides: mode, strength, and the joints of the model.

    Blender evaluates a bone after those above it, so the last of each chain stand for all.
    """
    bones = scene_rig.armature_object.data.bones
    # Joints that are gone are asked for no more; whoever reads the pose notices.
    known = [name for name in joints if name in bones]
    above = {bone.name for name in known for bone in bones[name].parent_recursive}
    return [
        ("SINGLE_PROP", scene_rig.mesh_object, "fdda.mode"),
        ("SINGLE_PROP", scene_rig.mesh_object, "fdda.strength"),
        *(("TRANSFORMS", scene_rig.armature_object, name) for name in known if name not in above),
    ]


def connect(driven: bpy.types.Object, wanted: list[Variable]) -> None:
    """Have an object evaluated after other things, whenever one of them has been."""
    if [_read(variable) for variable in _variables(driven)] == wanted:
        return
    driven.driver_remove("location", 0)
    # Nothing sees where the object is. A sum needs no Python, so it is evaluated where scripts may not run.
    curve = driven.driver_add("location", 0)
    curve.driver.type = "SUM"
    for place, variable in enumerate(wanted):
        _write(curve.driver.variables.new(), f"v{place}", variable)


def getter(driven: bpy.types.Object) -> Variable:
    """The variable that runs the models which an object plays; the first. Its place does not matter to Blender."""
    return "SINGLE_PROP", driven, GETTER


def sources(driven: bpy.types.Object, count: int) -> list[bpy.types.ID | None]:
    """The datablocks of so many variables after the getter, evaluated as the object that they drive."""
    variables = driven.animation_data.drivers[0].driver.variables
    return [variable.targets[0].id for variable in variables[1 : 1 + count]]


def _variables(driven: bpy.types.Object) -> list[bpy.types.DriverVariable]:
    drivers = driven.animation_data.drivers if driven.animation_data else ()
    return list(drivers[0].driver.variables) if len(drivers) else []


def _read(variable: bpy.types.DriverVariable) -> Variable:
    target = variable.targets[0]
    return variable.type, target.id, target.data_path if variable.type == "SINGLE_PROP" else target.bone_target


def _write(variable: bpy.types.DriverVariable, name: str, wanted: Variable) -> None:
    kind, datablock, path = wanted
    variable.name, variable.type = name, kind
    target = variable.targets[0]
    if kind == "TRANSFORMS":
        target.id, target.bone_target = datablock, path
        return
    # A driver that was invalid once stays so.
    target.use_fallback_value = True
    target.id_type = datablock.id_type
    target.id, target.data_path = datablock, path
