# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the part of the section "Training Poses" that shows and edits the rotation limits of bones."""

import math
from collections.abc import Iterable

import bpy

from ..core.mathematics.poses import CONTROL, LOCATION, ROTATION, ROTATION_VECTOR, Channel
from ..poses.motion_range import (
    CONSTRAINT,
    DEFAULT,
    IK,
    find_local_limit,
    is_moved_by_constraints,
    location_ranges,
    rotation_ranges,
)
from ..properties.recording_options import bones_to_pose
from ..scene.compatibility import is_selected, selection_owner
from ..scene.draw_cache import computed_once, draw_cached
from ..scene.scene_rig import SceneRig
from . import checks, sampling
from .section import panel_rig, short_bone_name

AXES = "xyz"
WIDE_SIDEBAR_PIXELS = 380
"""Sidebar width from which the table shows both ends of a range, pixels at a UI scale of 1."""
LOCKED = {True: "locked", False: "lock"}
"""Text for a locked axis in a wide and in a narrow sidebar."""


class FDDA_UL_bones(bpy.types.UIList):
    """List of the bones that random poses move, with their rotation limits about each axis."""

    def filter_items(self, context: bpy.types.Context, data: object, name: str) -> tuple[list[int], list[int]]:
        rig = panel_rig(context)[0]
        return (list(_visible_bone_flags(rig, self.filter_name.lower(), self.bitflag_filter_item)) if rig else []), []

    def draw_item(self, context: bpy.types.Context, layout: bpy.types.UILayout, _data, bone, _icon, _active, _name):
        rig = panel_rig(context)[0]
        if rig is None:
            return
        region = context.region
        is_wide = region is not None and region.width >= WIDE_SIDEBAR_PIXELS * _ui_scale(context.preferences)
        icon, name, ranges, has_limits = _bone_row(rig, bone, is_wide)
        row = layout.split(factor=0.5)
        name_row = row.row(align=True)
        # The checkbox is the selection in the viewport.
        box = "CHECKBOX_HLT" if is_selected(bone) else "CHECKBOX_DEHLT"
        name_row.prop(selection_owner(bone), "select", text="", icon=box, emboss=False)
        name_row.label(text=name, icon=icon)
        if not has_limits:
            row = row.row()
            row.active = False
        row.label(text=ranges)


@draw_cached
def _ui_scale(preferences: bpy.types.Preferences) -> float:
    return preferences.system.ui_scale


@draw_cached
def _visible_bone_flags(rig: SceneRig, search_text: str, flag: int) -> tuple[int, ...]:
    """Return a filter flag for each bone: whether random poses may move it and its name matches the search."""
    check, channels = checks.last_check(rig), sampled_channels_by_bone(rig)
    listed_bones = set(check.rig.joint_names) if check and check.rig else set()
    if channels is not None:
        listed_bones = set(channels)
    names = [bone.name for bone in rig.armature_object.pose.bones]
    return tuple(
        flag if (not listed_bones or name in listed_bones) and search_text in name.lower() else 0 for name in names
    )


@draw_cached
def _bone_row(rig: SceneRig, bone: bpy.types.PoseBone, is_wide: bool) -> tuple[str, str, str, bool]:
    """Return icon, name and limits of a bone for the list, and whether limits are set for the bone."""
    name = short_bone_name(bone.name)
    channels = sampled_channels_by_bone(rig)
    if channels is not None:
        return "NONE", name, _format_channels(channels.get(bone.name, ()), is_wide), True
    if is_moved_by_constraints(bone):
        return "CONSTRAINT_BONE", name, "constrained", False
    ranges = rotation_ranges(bone)
    texts = [_format_range(r.low, r.high, is_wide) if r.moves else LOCKED[is_wide] for r in ranges]
    return "NONE", name, "  ".join(texts), any(r.moves and r.source != DEFAULT for r in ranges)


def lacks_limits(rig: SceneRig) -> bool:
    """Return whether random poses rotate all bones by the default angle, because no bone has limits."""
    return bones_to_pose(rig) == "WEIGHTS" and not has_any_limits(rig)


def count_controlled_bones(rig: SceneRig) -> int:
    """Count the deforming bones that constraints move, not random poses; 0 if they are few, or others are chosen."""
    check, bones = checks.last_check(rig), rig.armature_object.pose.bones
    if check is None or check.rig is None or bones_to_pose(rig) != "WEIGHTS":
        return 0

    def count() -> int:
        names = check.rig.joint_names
        controlled = sum(is_moved_by_constraints(bones[name]) for name in names if name in bones)
        return controlled if 2 * controlled > len(names) else 0

    return computed_once(("controlled bones", rig.mesh_object.session_uid), (check,), count)


@draw_cached
def has_any_limits(rig: SceneRig) -> bool:
    """Return whether any bone of the armature had limits or a locked axis at the last check of the rig.

    Headers show it too, and a control rig has thousands of bones, so it is computed once for each check.
    """
    check, bones = checks.last_check(rig), rig.armature_object.pose.bones
    if check is None:
        return _have_limits(bones)
    return computed_once(("limits", rig.mesh_object.session_uid), (check,), lambda: _have_limits(bones))


def _have_limits(bones: Iterable[bpy.types.PoseBone]) -> bool:
    return any(r.source != DEFAULT or r.is_locked for bone in bones for r in rotation_ranges(bone))


@draw_cached
def sampled_channels_by_bone(rig: SceneRig) -> "dict[str, list[Channel]] | None":
    """Return the channels that random poses set, by bone; None for "Deforming Bones" or before the first check."""
    check = checks.last_check(rig)
    if bones_to_pose(rig) == "WEIGHTS" or check is None or not check.channels:
        return None

    by_bone: dict[str, list[Channel]] = {}
    for channel in check.channels:
        if channel.kind != CONTROL:
            by_bone.setdefault(channel.name, []).append(channel)
    return by_bone


def _format_channels(channels: "list[Channel]", is_wide: bool) -> str:
    """Return the rotation ranges of a bone, and the axes along which random poses move it, as text."""
    channels = [channel for channel in channels if channel.low < channel.high]
    rotations = {channel.axis: channel for channel in channels if channel.kind in {ROTATION, ROTATION_VECTOR}}
    location_axes = "".join("XYZ"[channel.axis] for channel in channels if channel.kind == LOCATION)
    texts = [
        _format_range(rotations[axis].low, rotations[axis].high, is_wide) if axis in rotations else LOCKED[is_wide]
        for axis in range(3)
        if rotations
    ]
    if location_axes:
        texts.append(f"Loc {location_axes}")
    return "  ".join(texts)


def _format_range(low: float, high: float, is_wide: bool) -> str:
    """Return a range in degrees, "±45°" or "-10…140°". In a narrow sidebar an asymmetric range is a width, "150°"."""
    low, high = round(math.degrees(low)), round(math.degrees(high))
    if low == -high:
        return f"±{high}°"
    return f"{low}…{high}°" if is_wide else f"{high - low}°"


def draw_limits(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    """Draw the sub-panel with the list of bones and the limits of the active bone."""
    header, body = layout.panel("fdda_limits", default_closed=True)
    header.label(text="Rotation Limits (X, Y, Z)")
    if body is None:
        return
    session, bones = context.window_manager.fdda, rig.armature_object.pose.bones
    body.template_list("FDDA_UL_bones", "", rig.armature_object.pose, "bones", session, "bone_index", rows=5)
    if 0 <= session.bone_index < len(bones):
        # Draw the limits of the active bone of the list; draw nothing if the list does not show the bone.
        bone = bones[session.bone_index]
        channels = sampled_channels_by_bone(rig)
        if channels is None:
            _draw_limits(body.box(), rig, bone)
        elif bone.name in channels:
            if bones_to_pose(rig) in {"ACTIONS", "REMIX"}:
                sampling.draw_channels(body.box(), bone, channels[bone.name])
            else:
                _draw_limits(body.box(), rig, bone)
    _draw_selected_bones(body, rig)


def _draw_selected_bones(layout: bpy.types.UILayout, rig: SceneRig) -> None:
    """Draw the sub-panel with the buttons for the selected bones."""
    header, body = layout.panel("fdda_many_bones", default_closed=True)
    count = _count_selected(rig)
    header.label(text=f"Selected Bones ({count})")
    if body is None:
        return
    column = body.column(align=True)
    column.enabled = count > 0
    column.operator("fdda.set_limits", text="Set Limits…", icon="DRIVER_ROTATIONAL_DIFFERENCE")
    row = column.row(align=True)
    row.operator("fdda.copy_limits", text="Copy to Selected", icon="COPYDOWN")
    row.operator("fdda.mirror_limits", text="Mirror to Other Side", icon="MOD_MIRROR")
    column.operator("fdda.clear_limits", text="Clear Limits", icon="X")


@draw_cached
def _count_selected(rig: SceneRig) -> int:
    return sum(map(is_selected, rig.armature_object.pose.bones))


@draw_cached
def _read_limits(rig: SceneRig, bone: bpy.types.PoseBone) -> tuple[str, list, tuple[int, ...]]:
    """Return a label with name and kind of limits of a bone, its rotation ranges, and its location axes."""
    ranges = rotation_ranges(bone)
    names = {CONSTRAINT: "Limit Rotation", IK: "IK Limits"}
    sources = {r.source for r in ranges if r.moves and r.source != DEFAULT}
    locations = () if bone.bone.use_connect else tuple(location_ranges(bone))
    return f"{bone.name}: {', '.join(names[source] for source in sorted(sources)) or 'no limits'}", ranges, locations


def _draw_limits(box: bpy.types.UILayout, rig: SceneRig, bone: bpy.types.PoseBone) -> None:
    """Draw the limits of a bone as fields of Blender's own properties."""
    text, ranges, locations = _read_limits(rig, bone)
    box.label(text=text, icon="BONE_DATA")
    column = box.column(align=True)
    for axis, axis_range in enumerate(ranges):
        row = column.split(factor=0.25, align=True)
        # Blender draws the icon after UNLOCKED, a closed lock, if the axis is locked.
        row.prop(bone, "lock_rotation", index=axis, text=AXES[axis].upper(), icon="UNLOCKED", toggle=1)
        fields = row.row(align=True)
        fields.enabled = not bone.lock_rotation[axis]
        if axis_range.source == DEFAULT:
            text = "locked (IK)" if axis_range.is_locked and not bone.lock_rotation[axis] else "±45° (default)"
            fields.label(text="locked" if bone.lock_rotation[axis] else text)
            _draw_limit_button(fields, rig, bone, axis, "fdda.set_limits", "ADD")
            continue
        owner, prefix = (
            (find_local_limit(bone, "LIMIT_ROTATION"), "") if axis_range.source == CONSTRAINT else (bone, "ik_")
        )
        fields.prop(owner, f"{prefix}min_{AXES[axis]}", text="")
        fields.prop(owner, f"{prefix}max_{AXES[axis]}", text="")
        _draw_limit_button(fields, rig, bone, axis, "fdda.clear_limits", "X")
    for axis in locations:
        row = column.row(align=True)
        limit = find_local_limit(bone, "LIMIT_LOCATION")
        row.prop(bone, "lock_location", index=axis, text=f"Location {AXES[axis].upper()}", toggle=1)
        row.prop(limit, f"min_{AXES[axis]}", text="")
        row.prop(limit, f"max_{AXES[axis]}", text="")


def _draw_limit_button(
    layout: bpy.types.UILayout, rig: SceneRig, bone: bpy.types.PoseBone, axis: int, operator: str, icon: str
) -> None:
    properties = layout.operator(operator, text="", icon=icon)
    properties.object, properties.bone = rig.mesh_object.name, bone.name
    properties.axes = tuple(index == axis for index in range(3))
    if operator == "fdda.set_limits":
        # Otherwise Blender would use the values of the last call.
        properties.low, properties.high = (-math.pi / 4,) * 3, (math.pi / 4,) * 3
