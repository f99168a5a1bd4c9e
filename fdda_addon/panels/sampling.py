# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the part of the section "Training Poses" that chooses the bones and extra inputs of random poses."""

import math

import bpy

from ..core.mathematics.poses import CONTROL, LOCATION, ROTATION, ROTATION_VECTOR, Channel
from ..properties.recording_options import describe_chosen_bones, recorded_actions
from ..recording.rig_check import RigCheck
from ..scene.scene_rig import SceneRig
from . import checks
from .section import draw_wrapped

MAX_SHOWN_CONTROLS = 8
"""Largest number of detected extra inputs that the panel lists."""

BONE_ICONS = {"bone:": "BONE_DATA", "collection:": "GROUP_BONE"}
"""Icons of the extra inputs that are control bones, by the prefix of their names (`poses.sample_selection`)."""


class FDDA_UL_controls(bpy.types.UIList):
    """List of the extra inputs that the user has added, with their ranges."""

    def draw_item(self, _context: bpy.types.Context, layout: bpy.types.UILayout, _data, control, _icon, _active, _name):
        row = layout.row()
        if control.name.startswith(tuple(BONE_ICONS)):
            kind, _, name = control.name.partition(":")
            row.label(text=name, icon=BONE_ICONS[f"{kind}:"])
            return
        text = control.name.rpartition("/")[2] or "(unnamed)"
        row.label(text=text, icon="SHAPEKEY_DATA" if "/" not in control.name else "DRIVER")
        right_part = row.row()
        right_part.alignment = "RIGHT"
        right_part.label(text=f"{control.low:g}…{control.high:g}" if control.has_range else "default")


def draw_bones_to_pose(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    """Draw the settings that choose the bones of random poses."""
    settings = rig.mesh_object.fdda.settings
    column = layout.column()
    column.label(text="Bones to Pose")
    column.prop(settings, "bones_to_pose", text="")
    if settings.bones_to_pose == "COLLECTION":
        column.prop_search(settings, "bone_collection", rig.armature_object.data, "collections_all", text="")
    elif settings.bones_to_pose == "ACTIONS" and not recorded_actions(rig):
        draw_wrapped(column, context, "Check the actions below that show how the rig moves.", "INFO")
    elif settings.bones_to_pose in {"AUTO", "REMIX"}:
        draw_wrapped(column, context, describe_chosen_bones(rig))
    elif settings.bones_to_pose == "SELECTED":
        count = len(settings.sampled_bones)
        if not count:
            draw_wrapped(column, context, "Select bones in Pose Mode, then press the button.", "INFO")
        column.operator("fdda.use_selected_bones", icon="RESTRICT_SELECT_OFF").object = rig.mesh_object.name


def draw_channel_counts(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    """Draw how many bones and extra inputs random poses move."""
    check = checks.last_check(rig)
    if check is not None and check.channels:
        draw_wrapped(layout, context, describe_channels(check))


def describe_channels(check: "RigCheck") -> str:
    """Return a sentence with the numbers of bones and extra inputs that random poses move."""
    channels = [channel for channel in check.channels if channel.kind != CONTROL]
    bone_count, control_count = len({channel.name for channel in channels}), len(check.channels) - len(channels)
    parts = []
    if bone_count:
        parts.append(f"{_count_text(bone_count, 'bone')} ({_count_text(len(channels), 'channel')})")
    if control_count:
        parts.append(_count_text(control_count, "extra input"))
    return f"Random poses will move {' and '.join(parts)}."


def _count_text(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def draw_channels(box: bpy.types.UILayout, bone: bpy.types.PoseBone, channels: "list[Channel]") -> None:
    """Draw the ranges of a bone as labels, because ranges from actions cannot be edited."""
    box.label(text=f"{bone.name} (from actions)", icon="BONE_DATA")
    column = box.column(align=True)
    kind_labels = {ROTATION: "Rotation", ROTATION_VECTOR: "Rotation", LOCATION: "Location"}
    for channel in channels:
        row = column.split(factor=0.4)
        row.label(text=f"{kind_labels.get(channel.kind, 'Scale')} {'XYZ'[channel.axis]}")
        low, high = channel.low, channel.high
        if channel.kind in {ROTATION, ROTATION_VECTOR}:
            row.label(text=f"{math.degrees(low):.0f}…{math.degrees(high):.0f}°")
        else:
            row.label(text=f"{low:.3g}…{high:.3g}")


def draw_extra_inputs(layout: bpy.types.UILayout, rig: SceneRig) -> None:
    """Draw the extra inputs that the user has added, and those that were detected."""
    settings, check = rig.mesh_object.fdda.settings, checks.last_check(rig)
    detected = check.automatic_controls if check is not None else ()
    count = len(check.rig.controls) if check is not None and check.rig else len(settings.extra_inputs)
    header, body = layout.panel("fdda_controls", default_closed=True)
    header.label(text=f"Extra Inputs ({count})" if count else "Extra Inputs")
    if body is None:
        return
    row = body.row()
    row.template_list("FDDA_UL_controls", "", settings, "extra_inputs", settings, "extra_input_index", rows=2)
    buttons = row.column(align=True)
    buttons.operator("fdda.add_control", text="", icon="ADD").object = rig.mesh_object.name
    buttons.operator("fdda.remove_control", text="", icon="REMOVE").object = rig.mesh_object.name
    if 0 <= settings.extra_input_index < len(settings.extra_inputs):
        control = settings.extra_inputs[settings.extra_input_index]
        column = body.column(align=True)
        column.prop(control, "name", text="", placeholder="Shape key or data path")
        # Each channel of a control bone has the range of the bone.
        if not control.name.startswith(tuple(BONE_ICONS)):
            row = column.row(align=True)
            row.prop(control, "has_range", text="Override Range")
            fields = row.row(align=True)
            fields.active = control.has_range
            fields.prop(control, "low", text="")
            fields.prop(control, "high", text="")
    body.operator("fdda.add_control_bones", icon="BONE_DATA").object = rig.mesh_object.name
    if detected:
        column = body.column(align=True)
        column.label(text="Detected automatically")
        if key_count := sum(control.is_shape_key for control in detected):
            column.label(text=_count_text(key_count, "shape key"), icon="SHAPEKEY_DATA")
        detected = [control for control in detected if not control.is_shape_key]
        for control in detected[:MAX_SHOWN_CONTROLS]:
            column.label(text=f"{control.name} {control.low:g}…{control.high:g}", icon="DOT")
        if len(detected) > MAX_SHOWN_CONTROLS:
            column.label(text=f"and {len(detected) - MAX_SHOWN_CONTROLS} more", icon="BLANK1")
