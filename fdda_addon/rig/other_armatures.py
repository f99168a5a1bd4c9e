# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks the bones of other armatures that deform a mesh. Their free channels must be controls of the model."""

from collections.abc import Iterable, Iterator

import bpy

from ..core.controls import OTHER_OBJECT, Control
from ..core.errors import RigError
from ..core.mathematics.poses import LOCATION, ROTATION, SCALE
from ..poses.motion_range import location_ranges, rotation_ranges, scale_ranges
from ..scene.action_slots import is_overridden
from ..scene.controls import fcurve_target, make_control
from ..scene.scene_rig import SceneRig
from .references import is_transform_channel, split_bone_path
from .sources import Sources

_FOUR_COMPONENT_MODES = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}
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
    for armature_object, bone, path in _channels_read_by_drivers(scene_rig, sources):
        bounds = _channel_range(bone, path)
        if bounds is not None and bounds[0] < bounds[1]:
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
    for armature_object, _, path in _channels_read_by_drivers(scene_rig, sources):
        if fcurve_target(armature_object, path) not in input_keys:
            raise RigError(
                f"A driver of '{scene_rig.mesh_object.name}' reads '{path}' of a second armature, "
                f"'{armature_object.name}', which is no input of the model; name it as a control with a range "
                f"(--extra-input '{OTHER_OBJECT}{armature_object.name}/{path}=LOW:HIGH'), or lock it."
            )


def _remedies(bone: bpy.types.PoseBone, free_kinds: list[str]) -> Iterator[str]:
    if ROTATION in free_kinds:
        has_four_components = bone.rotation_mode in _FOUR_COMPONENT_MODES
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
) -> Iterator[tuple[bpy.types.Object, bpy.types.PoseBone, str]]:
    """Yield the unlocked channels of bones of other armatures that drivers read by path."""
    for datablock, path in sources.numbers:
        name, subpath = split_bone_path(datablock, path)
        if name and datablock != scene_rig.armature_object and is_transform_channel(subpath):
            bone = datablock.pose.bones.get(name)
            if bone is not None and _can_vary(_channel_range(bone, path)):
                yield datablock, bone, path


def _channel_range(bone: bpy.types.PoseBone, path: str) -> tuple[float, float] | None:
    """Return the range of one component of a channel; None without a range, and an empty range if it is locked."""
    channel, axis = path.rpartition(".")[2][:-3], int(path[-2])
    if channel == LOCATION:
        return (0.0, 0.0) if bone.lock_location[axis] else location_ranges(bone).get(axis)
    if channel == SCALE:
        return (0.0, 0.0) if bone.lock_scale[axis] else scale_ranges(bone).get(axis)
    if channel == "rotation_euler" and bone.rotation_mode not in _FOUR_COMPONENT_MODES:
        rotation_range = rotation_ranges(bone)[axis]
        return (rotation_range.low, rotation_range.high) if rotation_range.moves else (0.0, 0.0)
    return (0.0, 0.0) if all(bone.lock_rotation) else None


def _can_vary(bounds: tuple[float, float] | None) -> bool:
    return bounds is None or bounds[0] < bounds[1]


def _free_channels(bone: bpy.types.PoseBone) -> Iterator[tuple[str, str, AxisRanges]]:
    """Yield kind, property and ranges of the channels that are free to move a bone."""
    if bone.rotation_mode in _FOUR_COMPONENT_MODES:
        if not all(bone.lock_rotation) and not is_overridden(bone, ROTATION):
            yield ROTATION, _FOUR_COMPONENT_MODES[bone.rotation_mode], dict.fromkeys(range(4))
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
