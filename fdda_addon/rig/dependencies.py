# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the bones and numbers that drivers and modifiers of meshes read, so that the meshes depend on them.

The values of their shape keys are inputs of a model, so bones and numbers that act through these alone are no inputs.

Bones of other armatures are checked: their free channels must be controls of the model.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import bpy

from ..core.controls import EVALUATION_TIME, OTHER_OBJECT, SHAPE_KEYS, Control
from ..core.errors import RigError
from ..core.mathematics.poses import LOCATION, ROTATION, SCALE
from ..poses.motion_range import location_ranges, rotation_ranges, scale_ranges
from ..scene.action_slots import CurvesByDatablock, changes_value, curves_of_actions, curves_with_actions, is_overridden
from ..scene.armature import FOUR_COMPONENT_ROTATIONS
from ..scene.controls import canonical_path, driven_numbers, fcurve_target, is_number, make_control, owner_name
from ..scene.scene_rig import SceneRig
from .references import is_transform_channel, split_bone_path
from .sources import Sources

_VERBS = {ROTATION: "rotate", LOCATION: "move", SCALE: "scale"}

AxisRanges = dict[int, tuple[float, float] | None]
"""Ranges of free channels by axis; None for a channel without a range."""


def controls_of_other_armatures(scene_rig: SceneRig, sources: Sources) -> Iterator[Control]:
    """Yield the channels of bones of other armatures that deform a mesh, as controls with their ranges of motion.

    Rotations are Euler angles: the four components of a quaternion have no ranges, and q and -q are the same rotation.
    """
    for armature_object, bone in _deforming_bones(scene_rig, sources):
        for _, channel, ranges in _free_channels(bone):
            for axis, bounds in ranges.items():
                if bounds is not None and bounds[0] < bounds[1]:
                    owner = f"{OTHER_OBJECT}{armature_object.name}"
                    yield make_control(scene_rig, owner, f"{bone.path_from_id()}.{channel}[{axis}]", bounds)
    for armature_object, path, bounds in _channels_read_by_drivers(scene_rig, sources):
        if bounds is not None:
            yield make_control(scene_rig, f"{OTHER_OBJECT}{armature_object.name}", path, bounds)


def check_other_armatures(
    scene_rig: SceneRig, sources: Sources, controls: Iterable[tuple[bpy.types.ID, str, int]]
) -> None:
    """Check that bones of other armatures deform a mesh only by channels that are controls or driven.

    Args:
        sources: everything on which its mesh depends.
        controls: the controls of the model, in the form that `scene.controls.fcurve_target` returns.

    Raises:
        RigError: a bone has a free channel that is no control; the message names the bone and its armature.
    """
    input_keys = {*controls, *sources.drivers}
    for armature_object, bone in _deforming_bones(scene_rig, sources):
        path = bone.path_from_id()
        free_kinds = [
            kind
            for kind, channel, ranges in _free_channels(bone)
            if any(
                (armature_object, f"{path}.{channel}", axis) not in input_keys
                for axis in ranges
                if _can_vary(ranges[axis])
            )
        ]
        if free_kinds:
            raise RigError(
                f"'{scene_rig.mesh_object.name}' follows the bone '{bone.name}' of a second armature, "
                f"'{armature_object.name}', which can {' and '.join(_VERBS[kind] for kind in free_kinds)}, but is no "
                f"input of the model; {' and '.join(_remedies(bone, free_kinds))}, or join the armatures."
            )
    for armature_object, path, _ in _channels_read_by_drivers(scene_rig, sources):
        if fcurve_target(armature_object, path) not in input_keys:
            raise RigError(
                f"A driver of '{scene_rig.mesh_object.name}' reads '{path}' of a second armature, "
                f"'{armature_object.name}', which is no input of the model; name it as a control with a range "
                f"(--extra-input '{OTHER_OBJECT}{armature_object.name}/{path}=LOW:HIGH'), or lock it."
            )


def _remedies(bone: bpy.types.PoseBone, free_kinds: list[str]) -> Iterator[str]:
    if ROTATION in free_kinds:
        has_four_components = bone.rotation_mode in FOUR_COMPONENT_ROTATIONS
        yield "set its rotation mode to XYZ Euler" if has_four_components else "name its rotation as controls"
    if other_kinds := [kind for kind in free_kinds if kind != ROTATION]:
        limits = " and ".join(f"Limit {kind.title()}" for kind in other_kinds)
        yield f"lock its {' and '.join(other_kinds)} (or add {limits} in local space)"


def _deforming_bones(scene_rig: SceneRig, sources: Sources) -> Iterator[tuple[bpy.types.Object, bpy.types.PoseBone]]:
    for armature_object, names in sources.bones.items():
        if armature_object != scene_rig.armature_object:
            yield from ((armature_object, bone) for bone in armature_object.pose.bones if bone.name in names)


def _channels_read_by_drivers(
    scene_rig: SceneRig, sources: Sources
) -> Iterator[tuple[bpy.types.Object, str, tuple[float, float] | None]]:
    """Yield the unlocked channels of bones of other armatures that drivers read by path, with their ranges."""
    for datablock, path in sources.numbers:
        name, subpath = split_bone_path(datablock, path)
        bone = datablock.pose.bones.get(name) if name and is_transform_channel(subpath) else None
        if bone is not None and datablock != scene_rig.armature_object and is_number(datablock, path):
            bounds = _channel_range(bone, *subpath[1:-1].split("["))
            if _can_vary(bounds):
                yield datablock, path, bounds


def _channel_range(bone: bpy.types.PoseBone, channel: str, index: str) -> tuple[float, float] | None:
    """Return the range of a channel, whether or not it moves the bone; empty if it is locked, None without a range."""
    axis = int(index)
    if channel in (LOCATION, SCALE):
        is_locked = getattr(bone, f"lock_{channel}")[axis]
        ranges = location_ranges(bone) if channel == LOCATION else scale_ranges(bone)
        return (0.0, 0.0) if is_locked else ranges.get(axis)
    if channel == "rotation_euler" and bone.rotation_mode not in FOUR_COMPONENT_ROTATIONS:
        rotation_range = rotation_ranges(bone)[axis]
        return (rotation_range.low, rotation_range.high) if rotation_range.moves else (0.0, 0.0)
    return (0.0, 0.0) if all(bone.lock_rotation) else None


def _can_vary(bounds: tuple[float, float] | None) -> bool:
    return bounds is None or bounds[0] < bounds[1]


def _free_channels(bone: bpy.types.PoseBone) -> Iterator[tuple[str, str, AxisRanges]]:
    """Yield kind, property and ranges of the channels that are free to move a bone."""
    if bone.rotation_mode in FOUR_COMPONENT_ROTATIONS:
        if not all(bone.lock_rotation) and not is_overridden(bone, ROTATION):
            yield ROTATION, FOUR_COMPONENT_ROTATIONS[bone.rotation_mode], dict.fromkeys(range(4))
    elif not is_overridden(bone, ROTATION):
        yield (
            ROTATION,
            "rotation_euler",
            {axis: (r.low, r.high) for axis, r in enumerate(rotation_ranges(bone)) if r.moves},
        )
    other_channels = [(SCALE, bone.lock_scale, scale_ranges(bone))]
    if not (bone.parent and bone.bone.use_connect):
        other_channels.insert(0, (LOCATION, bone.lock_location, location_ranges(bone)))
    for kind, locks, ranges in other_channels:
        if not is_overridden(bone, kind):
            yield kind, kind, {axis: ranges.get(axis) for axis in range(3) if not locks[axis]}


@dataclass(frozen=True)
class Dependencies:
    """Bones and controls on which the meshes of a rig depend besides their skin weights.

    Attributes:
        bones: names of bones of the armature that their drivers read, or that move objects their modifiers read.
        controls: values of their shape keys, numbers that other drivers read, and keyed shape keys of other objects,
            with the ranges of their properties.
        key_bones, key_numbers: names of bones, and of controls, that act through the shape keys of the meshes alone.
    """

    bones: frozenset[str]
    controls: tuple[Control, ...]
    key_bones: frozenset[str] = frozenset()
    key_numbers: frozenset[str] = frozenset()


def read_dependencies(
    scene_rig: SceneRig, actions: Iterable[bpy.types.Action] = (), *, has_random_poses: bool = True
) -> Dependencies:
    """Find the bones and controls on which the meshes of a rig depend.

    Numbers without a range are left out; a user can list them.

    Args:
        actions: further actions that may be played.
        has_random_poses: random poses set the values of shape keys that have no driver. Without these, a value that no
            action keys never changes.
    """
    controls: dict[str, Control] = {}
    bones, all_bones, key_numbers = set(), set(), set()
    for mesh_object in scene_rig.mesh_objects:
        sources, all_sources = (
            Sources(scene_rig, mesh_object, follows_shape_keys=follows) for follows in (False, True)
        )
        curves_by_action = curves_of_actions(actions, mesh_object, scene_rig.armature_object)
        key_values = list(_key_values(scene_rig, mesh_object, curves_by_action, has_random_poses))
        other_names = *_driver_inputs(sources), *_keyed_shape_keys(sources, curves_by_action)
        for control in controls_of_other_armatures(scene_rig, sources):
            controls.setdefault(control.name, control)
        for name in (*key_values, *other_names):
            owner, _, path = name.partition("/")
            with suppress(RigError):
                control = make_control(scene_rig, owner, path)
                controls.setdefault(control.name, control)
        key_numbers |= {*_driver_inputs(all_sources)}
        key_numbers |= {control.name for control in controls_of_other_armatures(scene_rig, all_sources)}
        bones |= sources.rig_bones
        all_bones |= all_sources.rig_bones
    bones, all_bones = (
        frozenset(each).intersection(scene_rig.armature_object.data.bones.keys()) for each in (bones, all_bones)
    )
    return Dependencies(bones, tuple(controls.values()), all_bones - bones, frozenset(key_numbers - controls.keys()))


def _key_values(
    scene_rig: SceneRig,
    mesh_object: bpy.types.Object,
    curves_by_action: Sequence[CurvesByDatablock],
    has_random_poses: bool,
) -> Iterator[str]:
    """Yield the names of the controls that are values of the shape keys of one mesh, or their evaluation time."""
    shape_keys = mesh_object.data.shape_keys
    # While one key is shown alone, the values have no effect.
    if shape_keys is None or mesh_object.show_only_shape_key:
        return
    keyed_curves = curves_with_actions(shape_keys, curves_by_action)
    changing_paths = {canonical_path(shape_keys, curve.data_path) for curve in keyed_curves if changes_value(curve)}
    changing_paths |= {path for path, _ in driven_numbers(shape_keys)}
    if shape_keys.use_relative:
        blocks = [block for block in shape_keys.key_blocks if block != shape_keys.reference_key and not block.mute]
        paths = [f'key_blocks["{bpy.utils.escape_identifier(block.name)}"].value' for block in blocks]
    else:
        paths = [EVALUATION_TIME]
    owner = owner_name(scene_rig, shape_keys)
    yield from (f"{owner}/{path}" for path in paths if has_random_poses or path in changing_paths)


def deforming_mesh_objects(scene_rig: SceneRig, mesh_object: bpy.types.Object) -> list[bpy.types.Object]:
    """Find the other mesh objects that deform a mesh."""
    sources = Sources(SceneRig(mesh_object, scene_rig.armature_object), mesh_object).objects
    return [
        source_object
        for source_object, uses_geometry in list(sources.items())[1:]
        if uses_geometry and source_object.type == "MESH"
    ]


def _driver_inputs(sources: Sources) -> Iterator[str]:
    """Yield the names of the controls that drivers read."""
    for datablock, path in sources.numbers:
        if name := sources.control_name(datablock, path):
            yield name


def _keyed_shape_keys(sources: Sources, curves_by_action: Sequence[CurvesByDatablock]) -> Iterator[str]:
    """Yield the names of the controls that are values of keyed shape keys of other objects, such as a lattice."""
    for shape_keys, prefix in sources.datablocks.items():
        if not isinstance(shape_keys, bpy.types.Key) or prefix.startswith(SHAPE_KEYS):
            continue
        keyed_curves = curves_with_actions(shape_keys, curves_by_action)
        keyed_paths = {canonical_path(shape_keys, curve.data_path) for curve in keyed_curves if changes_value(curve)}
        for block in shape_keys.key_blocks:
            if (
                (path := block.path_from_id("value")) in keyed_paths
                and not block.mute
                and block != shape_keys.reference_key
            ):
                yield sources.control_name(shape_keys, path)
