# SPDX-License-Identifier: GPL-3.0-or-later
"""What moves a surface beside the pose without a model being told: keys, drivers and modifiers that depend on time."""

import ast
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import bpy

from ..core.controls import Control
from ..core.errors import RigError
from ..scene.animation import changes_value, curves_with_actions, value_range
from ..scene.controls import fcurve_target, owner_of
from ..scene.scene_rig import SceneRig
from .modifier_stack import ModifierStack, is_fdda_modifier, time_dependence
from .other_armatures import check_other_armatures
from .sources import Curve, Sources

_FRAME = {"frame", "frame_current", "frame_current_final", "frame_float", "frame_subframe"}
_TRACKING = {"FOLLOW_TRACK", "CAMERA_SOLVER", "OBJECT_SOLVER", "TRANSFORM_CACHE"}
_MOVING_IMAGES = {"MOVIE", "SEQUENCE"}
_MUTE = "mute it, or let it read a number that is a control"

Place = tuple[bpy.types.ID, str, int]
"""A number as `scene.controls.fcurve_target` gives it."""


@dataclass(frozen=True)
class TimeInput:
    """Something that changes a surface with time.

    Attributes:
        words: what it is, "the driver of 'location' of 'handle'".
        remedy: what a user can do about it.
    """

    words: str
    remedy: str


def check_time_inputs(
    scene_rig: SceneRig,
    controls: Iterable[Control],
    stack: ModifierStack,
    actions: Iterable[bpy.types.Action] = (),
) -> None:
    """Fail where the surface of a mesh follows from more than the pose of its armature and the controls of a model.

    Args:
        scene_rig: the rig.
        controls: of the model, or of the recording that is made.
        stack: of the mesh object.
        actions: whose frames are recorded.

    Raises:
        RigError: names what depends on time, or a bone of another armature.
    """
    mesh_object = scene_rig.mesh_object
    names = [modifier.name for modifier in mesh_object.modifiers if not is_fdda_modifier(modifier)][
        : stack.insert_index
    ]
    sources = Sources(scene_rig, mesh_object, names)
    owners = [(owner_of(scene_rig, control.owner), control.path) for control in controls]
    places = {fcurve_target(owner, path) for owner, path in owners if owner is not None}
    for found in (*_modifiers_in_time(sources), *time_inputs(sources, places, actions)):
        raise RigError(
            f"The surface of '{mesh_object.name}' changes with time through {found.words}, so it does not follow from "
            f"the pose; {found.remedy}."
        )
    check_other_armatures(scene_rig, sources, places)


def time_inputs(
    sources: Sources, controls: Iterable[Place] = (), actions: Iterable[bpy.types.Action] = ()
) -> Iterator[TimeInput]:
    """What changes a surface with time, modifiers left out.

    Args:
        sources: what the surface is computed from.
        controls: numbers that may change.
        actions: that may be played beside what is active.
    """
    controls, actions = set(controls), tuple(actions)
    for datablock in (*sources.objects, *sources.datablocks):
        for curve in curves_with_actions(datablock, actions):
            place = (datablock, curve.data_path, curve.array_index)
            if place not in controls and sources.affects_surface(datablock, curve.data_path) and changes_value(curve):
                yield _keyed(sources, datablock, curve)
    numbers = [*sources.numbers, *((scene, path) for _, scene, path in sources.scene_reads)]
    for place in dict.fromkeys(fcurve_target(*number) for number in numbers):
        for curve in curves_with_actions(place[0], actions):
            if (curve.data_path, curve.array_index) == place[1:] and place not in controls and changes_value(curve):
                yield _keyed(sources, place[0], curve)
    for driver, _, path in sources.scene_reads:
        if path in _FRAME:
            yield _driven(driver)
    for driver in sources.drivers.values():
        if _reads_frame(driver[1].driver):
            yield _driven(driver)
    for scene_object in sources.objects:
        name = scene_object.name
        world = bpy.context.scene.rigidbody_world
        if scene_object.rigid_body and world and world.enabled and scene_object.rigid_body.type == "ACTIVE":
            yield TimeInput(f"the rigid body of '{name}'", "bake it to a pose, or remove it")
        for constraint in scene_object.constraints:
            if constraint.type in _TRACKING and not constraint.mute:
                yield TimeInput(f"the constraint '{constraint.name}' of '{name}'", "mute it, or remove it")
    for texture in sources.datablocks:
        image = getattr(texture, "image", None)
        if image is not None and image.source in _MOVING_IMAGES:
            yield TimeInput(f"the image '{image.name}' of '{texture.name}'", "choose a still image")


def _modifiers_in_time(sources: Sources) -> Iterator[TimeInput]:
    """Of the objects that a mesh reads: a cage that is cloth, a lattice that waves."""
    for scene_object, uses_geometry in list(sources.objects.items())[1:]:
        for modifier in scene_object.modifiers if uses_geometry else ():
            if modifier.show_viewport and (what := time_dependence(modifier)):
                words = f"the modifier '{modifier.name}' of '{scene_object.name}', which {what}"
                yield TimeInput(words, "switch it off in the viewport, or remove it")


def _keyed(sources: Sources, datablock: bpy.types.ID, curve: bpy.types.FCurve) -> TimeInput:
    words = f"the keys of '{curve.data_path}' of '{datablock.name}'"
    name = sources.control_name(datablock, curve.data_path)
    if not name:
        return TimeInput(words, "remove them")
    try:
        is_array = hasattr(datablock.path_resolve(curve.data_path), "__len__")
    except ValueError:
        return TimeInput(words, "remove them")
    low, high = value_range(curve)
    path = f"{name}[{curve.array_index}]" if is_array else name
    return TimeInput(words, f"name what they set as a control (--control '{path}={low:g}:{high:g}'), or remove them")


def _driven(driver: Curve) -> TimeInput:
    datablock, curve = driver
    return TimeInput(f"the driver of '{curve.data_path}' of '{datablock.name}', which reads the frame", _MUTE)


def _reads_frame(driver: bpy.types.Driver) -> bool:
    """Whether the expression of a driver asks for the frame by itself, not through a variable."""
    if driver.type != "SCRIPTED":
        return False
    try:
        nodes = list(ast.walk(ast.parse(driver.expression.strip(), mode="eval")))
    except (SyntaxError, ValueError):
        return False
    variables = {variable.name for variable in driver.variables}
    names = {node.id for node in nodes if isinstance(node, ast.Name)} - variables
    return "frame" in names or any(isinstance(node, ast.Attribute) and node.attr in _FRAME for node in nodes)
