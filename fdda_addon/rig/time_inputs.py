# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the keyframes, drivers and modifiers that change a surface with time, besides the pose and the controls."""

import re
from collections.abc import Collection, Iterable, Iterator, Sequence

import bpy

from ..core.controls import Control
from ..core.errors import RigError
from ..core.wording import format_with_noun
from ..scene.action_slots import CurvesByDatablock, changes_value, curves_of_actions, curves_with_actions, value_range
from ..scene.controls import canonical_path, fcurve_target, is_driven, is_number, owner_of
from ..scene.scene_rig import SceneRig
from .dependencies import check_other_armatures
from .modifier_stack import ModifierStack, is_fdda_modifier, time_dependence
from .sources import TRANSFORM_PREFIXES, OwnedCurve, Sources, followed_objects


def describe_missing_ranges(
    scene_rig: SceneRig, sources: Sources, controls: Collection[tuple[bpy.types.ID, str, int]]
) -> str:
    """Describe the numbers that the drivers of a mesh read, and that no control and no driver sets.

    Args:
        sources: everything on which its mesh depends.
        controls: the controls of the model, in the form that `scene.controls.fcurve_target` returns.

    Returns:
        Sentences for the user; empty if there are no such numbers.
    """
    named, nameless = [], []
    for datablock, path in dict.fromkeys((*sources.numbers, *(read[1:] for read in sources.scene_reads))):
        # The places of objects on which the mesh depends are described by `describe_independent_objects`.
        is_place = datablock in sources.objects and path.startswith(TRANSFORM_PREFIXES)
        is_input = fcurve_target(datablock, path) in controls
        if is_place or is_input or not is_number(datablock, path) or is_driven(datablock, path):
            continue
        if name := sources.control_name(datablock, path):
            named.append(name)
        else:
            nameless.append(f"{path} of {datablock.name}")
    mesh_name, sentences = scene_rig.mesh_object.name, []
    if named:
        sentences.append(
            f"The surface of '{mesh_name}' depends on {format_with_noun(named, 'number')} without a range, so the "
            "model keeps the value in the recording. Make it an input with a range: --extra-input "
            f"'{named[0]}=LOW:HIGH', or Soft Min and Soft Max in the settings of the property."
        )
    if nameless:
        sentences.append(
            f"The surface of '{mesh_name}' depends on {format_with_noun(nameless, 'number')}, which cannot be an "
            "input, so the model keeps the value in the recording. Let the driver read a property of "
            f"'{scene_rig.armature_object.name}'."
        )
    return " ".join(sentences)


def describe_independent_objects(
    scene_rig: SceneRig, sources: Sources, controls: Iterable[tuple[bpy.types.ID, str, int]]
) -> str:
    """Describe the objects whose place deforms a mesh, although neither its rig nor a control or a driver moves them.

    Args:
        sources: everything on which its mesh depends.
        controls: the controls of the model, in the form that `scene.controls.fcurve_target` returns.

    Returns:
        A sentence for the user; empty if there are no such objects.
    """
    moved_by_inputs = {owner for owner, path, _ in (*controls, *sources.drivers) if path.startswith(TRANSFORM_PREFIXES)}
    followed = {*scene_rig.mesh_objects, *sources.carriers, *moved_by_inputs}
    names = [o.name for o in list(sources.objects)[1:] if not _follows(o, followed)]
    if not names:
        return ""
    return (
        f"The surface of '{scene_rig.mesh_object.name}' depends on the place of {format_with_noun(names, 'object')}, "
        f"which no parent or constraint attaches to '{scene_rig.armature_object.name}': the model keeps the place in "
        "the recording. If one has to move with the character, parent it to the armature or a bone; if something else "
        "moves it, make that an extra input (--extra-input)."
    )


def _follows(scene_object: bpy.types.Object, followed: set[bpy.types.Object]) -> bool:
    """Return whether an object is one of others, or follows one by parents and constraints."""
    chain = [scene_object]
    for link in chain:
        if link in followed:
            return True
        chain += [o for o in followed_objects(link) if o not in chain]
    return False


_FRAME_PROPERTIES = {"frame", "frame_current", "frame_current_final", "frame_float", "frame_subframe"}
_QUOTED_TEXT = re.compile(r"""(["']).*?\1""")
_TIME_CONSTRAINTS = {"FOLLOW_TRACK", "CAMERA_SOLVER", "OBJECT_SOLVER", "TRANSFORM_CACHE"}
_MOVING_IMAGE_SOURCES = {"MOVIE", "SEQUENCE"}
_DRIVER_REMEDY = "mute it, or let it read a number that is a control"

PropertyKey = tuple[bpy.types.ID, str, int]
"""Datablock, path and array index of a number, as `scene.controls.fcurve_target` returns them."""


TimeInput = tuple[str, str]
"""What changes a surface with time, such as "the driver of 'location' of 'handle'", and what the user can do."""


def check_time_inputs(
    scene_rig: SceneRig,
    controls: Iterable[Control],
    stack: ModifierStack,
    actions: Iterable[bpy.types.Action] = (),
    mesh_object: bpy.types.Object | None = None,
) -> str:
    """Check that the surface of one mesh of a rig depends only on the pose of its armature and on controls.

    Args:
        controls: the controls of the model or the recording.
        stack: the modifiers of the mesh object.
        actions: the actions whose frames are recorded.
        mesh_object: the mesh; None for the first mesh of the rig.

    Returns:
        Sentences for the user about objects that do not move with the rig (`describe_independent_objects`), and about
        numbers without a range (`describe_missing_ranges`); may be empty.

    Raises:
        RigError: the surface depends on time, or on a bone of another armature; the message names the cause.
    """
    mesh_object = mesh_object or scene_rig.mesh_object
    followed_modifiers = [modifier.name for modifier in mesh_object.modifiers if not is_fdda_modifier(modifier)][
        : stack.insert_index
    ]
    # The values of shape keys are inputs of a model, so their drivers may read the time.
    sources = Sources(scene_rig, mesh_object, followed_modifiers, follows_shape_keys=False)
    keys = control_keys(scene_rig, controls)
    curves_by_action = curves_of_actions(actions, mesh_object, scene_rig.armature_object)
    for description, remedy in (*_time_modifiers(sources), *time_inputs(sources, keys, curves_by_action)):
        raise RigError(
            f"The surface of '{mesh_object.name}' changes with time through {description}, so it does not follow from "
            f"the pose; {remedy}."
        )
    check_other_armatures(scene_rig, sources, keys)
    notes = describe_independent_objects(scene_rig, sources, keys), describe_missing_ranges(scene_rig, sources, keys)
    return " ".join(filter(None, notes))


def control_keys(scene_rig: SceneRig, controls: Iterable[Control]) -> set[PropertyKey]:
    """Return the numbers that controls read."""
    owners_and_paths = [(owner_of(scene_rig, control.owner), control.path) for control in controls]
    return {fcurve_target(owner, path) for owner, path in owners_and_paths if owner is not None}


def time_inputs(
    sources: Sources,
    controls: Iterable[PropertyKey] = (),
    curves_by_action: Sequence[CurvesByDatablock] = (),
) -> Iterator[TimeInput]:
    """Find everything except modifiers that changes a surface with time.

    Args:
        sources: everything on which the surface depends.
        controls: numbers that are controls, so that they may change.
        curves_by_action: F-curves of further actions that may be played (`curves_of_actions`).
    """
    controls = set(controls)
    for datablock in (*sources.objects, *sources.datablocks):
        for curve in curves_with_actions(datablock, curves_by_action):
            property_key = (datablock, canonical_path(datablock, curve.data_path), curve.array_index)
            if (
                property_key not in controls
                and sources.affects_surface(datablock, curve.data_path)
                and changes_value(curve)
            ):
                yield _keyed_input(sources, datablock, curve)
    numbers = [*sources.numbers, *((scene, path) for _, scene, path in sources.scene_reads)]
    for property_key in dict.fromkeys(fcurve_target(*number) for number in numbers):
        for curve in curves_with_actions(property_key[0], curves_by_action):
            if (
                (canonical_path(property_key[0], curve.data_path), curve.array_index) == property_key[1:]
                and property_key not in controls
                and changes_value(curve)
            ):
                yield _keyed_input(sources, property_key[0], curve)
    for owned_curve, _, path in sources.scene_reads:
        if path in _FRAME_PROPERTIES:
            yield _driver_input(owned_curve)
    for owned_curve in sources.drivers.values():
        if _reads_frame(owned_curve[1].driver):
            yield _driver_input(owned_curve)
    for scene_object in sources.objects:
        object_name = scene_object.name
        world = bpy.context.scene.rigidbody_world
        if scene_object.rigid_body and world and world.enabled and scene_object.rigid_body.type == "ACTIVE":
            yield (f"the rigid body of '{object_name}'", "bake it to a pose, or remove it")
        for constraint in scene_object.constraints:
            if constraint.type in _TIME_CONSTRAINTS and not constraint.mute:
                yield (f"the constraint '{constraint.name}' of '{object_name}'", "mute it, or remove it")
    for texture in sources.datablocks:
        image = getattr(texture, "image", None)
        if image is not None and image.source in _MOVING_IMAGE_SOURCES:
            yield (f"the image '{image.name}' of '{texture.name}'", "choose a still image")


def _time_modifiers(sources: Sources) -> Iterator[TimeInput]:
    """Find time-dependent modifiers of the objects that a mesh reads, such as a cage with cloth."""
    for scene_object, uses_geometry in list(sources.objects.items())[1:]:
        for modifier in scene_object.modifiers if uses_geometry else ():
            if modifier.show_viewport and (dependence := time_dependence(modifier)):
                description = f"the modifier '{modifier.name}' of '{scene_object.name}', which {dependence}"
                yield (description, "switch it off in the viewport, or remove it")


def _keyed_input(sources: Sources, datablock: bpy.types.ID, curve: bpy.types.FCurve) -> TimeInput:
    description = f"the keys of '{curve.data_path}' of '{datablock.name}'"
    name = sources.control_name(datablock, curve.data_path)
    if not name:
        return description, "remove them"
    try:
        is_array = hasattr(datablock.path_resolve(curve.data_path), "__len__")
    except ValueError:
        return description, "remove them"
    low, high = value_range(curve)
    path = f"{name}[{curve.array_index}]" if is_array else name
    remedy = f"name what they set as a control (--extra-input '{path}={low:g}:{high:g}'), or remove them"
    return description, remedy


def _driver_input(owned_curve: OwnedCurve) -> TimeInput:
    datablock, curve = owned_curve
    description = f"the driver of '{curve.data_path}' of '{datablock.name}', which reads the frame"
    return description, _DRIVER_REMEDY


def _reads_frame(driver: bpy.types.Driver) -> bool:
    """Return whether the expression of a driver reads the frame itself, not through a variable."""
    expression = _QUOTED_TEXT.sub("", driver.expression) if driver.type == "SCRIPTED" else ""
    names = set(re.findall(r"\w+", expression)) - {variable.name for variable in driver.variables}
    return not names.isdisjoint(_FRAME_PROPERTIES)
