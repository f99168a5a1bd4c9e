# SPDX-License-Identifier: GPL-3.0-or-later
"""Section "Poses": the range of motion, the random poses that are drawn from it, and the actions to record."""

import math
import time
from typing import TYPE_CHECKING

import bpy

from ..operators.poses import FDDA_OT_state_range
from ..operators.sampling import fits
from ..scene.scene_rig import SceneRig
from . import checks, sampled
from .section import Section, draw_sentence, panel_rig

if TYPE_CHECKING:  # Blender starts without numpy.
    from ..core.poses import Channel

AXES = "xyz"
WIDE = 380
"""From this width of the sidebar on the table has both ends of a range, pixels at a scale of 1."""
FITTING_SECONDS = 2.0

_fitting: dict[tuple[int, int], tuple[float, bool]] = {}
"""Whether an action fits an armature, by session_uid of both, and when that was found out."""


def fits_now(action: bpy.types.Action, armature_object: bpy.types.Object) -> bool:
    """As `fits`, which looks at every curve, but not at each redraw."""
    key, now = (action.session_uid, armature_object.session_uid), time.monotonic()
    if key not in _fitting or now - _fitting[key][0] > FITTING_SECONDS:
        _fitting[key] = (now, fits(action, armature_object))
    return _fitting[key][1]


class FDDA_UL_joints(bpy.types.UIList):
    """The joints of the rig, or the control bones that were chosen, with their range about each axis."""

    def filter_items(self, context: bpy.types.Context, data: object, name: str) -> tuple[list[int], list[int]]:
        rig = panel_rig(context)[0]
        check = checks.known(rig) if rig else None
        channels = sampled_by_bone(rig) if rig else None
        listed = set(check.rig.joint_names) if check and check.rig else set()
        if channels is not None:
            listed = set(channels)
        text = self.filter_name.lower()
        flags = [
            self.bitflag_filter_item if (not listed or bone.name in listed) and text in bone.name.lower() else 0
            for bone in getattr(data, name)
        ]
        return flags, []

    def draw_item(self, context: bpy.types.Context, layout: bpy.types.UILayout, _data, bone, _icon, _active, _name):
        from ..scene.motion_range import DEFAULT, rotation_ranges
        from ..scene.sampling import is_moved_by_constraints

        row = layout.split(factor=0.4)
        rig = panel_rig(context)[0]
        channels = sampled_by_bone(rig) if rig else None
        region = context.region
        is_wide = region is not None and region.width / context.preferences.system.ui_scale >= WIDE
        if channels is not None:
            row.label(text=bone.name, icon="BONE_DATA")
            _draw_sampled(row.row(align=True), channels.get(bone.name, ()), is_wide)
            return
        if is_moved_by_constraints(bone):
            row.label(text=bone.name, icon="CONSTRAINT_BONE")
            row.label(text="constrained")
            return
        row.label(text=bone.name, icon="BONE_DATA")
        row = row.row(align=True)
        for r in rotation_ranges(bone):
            cell = row.row()
            cell.active = r.moves and r.source != DEFAULT
            cell.label(text=_degrees(r.low, r.high, is_wide) if r.moves else "fixed")


def sampled_by_bone(rig: SceneRig) -> "dict[str, list[Channel]] | None":
    """Channels of the bones that a user has chosen to sample, by bone; None where none were chosen, or not known."""
    check = checks.known(rig)
    if rig.mesh_object.fdda.settings.sample == "WEIGHTS" or check is None or not check.channels:
        return None
    from ..core.poses import CONTROL

    found: dict[str, list[Channel]] = {}
    for channel in check.channels:
        if channel.kind != CONTROL:
            found.setdefault(channel.bone, []).append(channel)
    return found


def _draw_sampled(row: bpy.types.UILayout, channels: "list[Channel]", is_wide: bool) -> None:
    """The ranges about the axes, and by which other channels the bone is moved."""
    from ..core.poses import LOCATION, ROTATION

    turns = {channel.axis: channel for channel in channels if channel.kind == ROTATION}
    moves = "".join("XYZ"[channel.axis] for channel in channels if channel.kind == LOCATION)
    for axis in range(3) if turns else ():
        row.label(text=_degrees(turns[axis].low, turns[axis].high, is_wide) if axis in turns else "fixed")
    if moves:
        row.label(text=f"moves {moves}" if not turns else f"+{moves}")


def _degrees(low: float, high: float, is_wide: bool) -> str:
    """A range, or only its width where the sidebar is narrow."""
    low, high = math.degrees(low), math.degrees(high)
    return f"{low:.0f}…{high:.0f}°" if is_wide else f"{high - low:.0f}°"


class FDDA_UL_actions(bpy.types.UIList):
    """The actions of the file that move this rig, each with a box to tick."""

    def filter_items(self, context: bpy.types.Context, data: object, name: str) -> tuple[list[int], list[int]]:
        rig = panel_rig(context)[0]
        text = self.filter_name.lower()
        flags = [
            self.bitflag_filter_item
            if rig and text in action.name.lower() and fits_now(action, rig.armature_object)
            else 0
            for action in getattr(data, name)
        ]
        return flags, []

    def draw_item(self, _context: bpy.types.Context, layout: bpy.types.UILayout, _data, action, _icon, _active, _name):
        row = layout.row()
        row.prop(action.fdda, "record", text="")
        row.label(text=action.name, icon="ACTION")
        first, last = (round(frame) for frame in action.frame_range)
        side = row.row()
        side.alignment = "RIGHT"
        side.label(text=f"{last - first + 1} frames")


class FDDA_PT_poses(Section, bpy.types.Panel):
    bl_idname = "FDDA_PT_poses"
    bl_label = "Poses"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.usable_layout()
        rig = panel_rig(context)[0]
        if rig is None:
            return
        session, bones = context.window_manager.fdda, rig.armature_object.pose.bones
        sampled.draw_choice(layout, context, rig)
        layout.label(text="Range of motion about X, Y and Z")
        layout.template_list("FDDA_UL_joints", "", rig.armature_object.pose, "bones", session, "joint_index", rows=5)
        if 0 <= session.joint_index < len(bones):
            _draw_bone(layout, rig, bones[session.joint_index])
        sampled.draw_controls(layout, rig)
        _draw_random(layout, context, rig)
        _draw_actions(layout, context, rig)


def _draw_bone(layout: bpy.types.UILayout, rig: SceneRig, bone: bpy.types.PoseBone) -> None:
    """The active bone; where others are chosen than those that are listed, none."""
    channels = sampled_by_bone(rig)
    if channels is None:
        _draw_ranges(layout.box(), rig, bone)
    elif bone.name in channels:
        if rig.mesh_object.fdda.settings.sample == "ACTIONS":
            sampled.draw_channels(layout.box(), bone, channels[bone.name])
        else:
            _draw_ranges(layout.box(), rig, bone)


def _draw_ranges(box: bpy.types.UILayout, rig: SceneRig, bone: bpy.types.PoseBone) -> None:
    """The ranges of a bone as the fields in which Blender keeps them."""
    from ..scene.motion_range import CONSTRAINT, DEFAULT, IK, local_limit, location_ranges, rotation_ranges

    ranges = rotation_ranges(bone)
    where = {CONSTRAINT: "Limit Rotation", IK: "IK limits", DEFAULT: "default"}
    sources = {r.source for r in ranges if r.moves} or {DEFAULT}
    box.label(text=f"{bone.name} ({', '.join(where[source] for source in sorted(sources))})", icon="BONE_DATA")
    column = box.column(align=True)
    for axis, r in enumerate(ranges):
        row = column.split(factor=0.25, align=True)
        # Blender draws the next icon, a closed lock, for an axis that is locked.
        row.prop(bone, "lock_rotation", index=axis, text=AXES[axis].upper(), icon="UNLOCKED", toggle=1)
        fields = row.row(align=True)
        fields.enabled = not bone.lock_rotation[axis]
        if r.source == DEFAULT:
            text = "fixed (IK lock)" if r.is_locked and not bone.lock_rotation[axis] else "±45°, not stated"
            fields.label(text="locked" if bone.lock_rotation[axis] else text)
            _draw_state_button(fields, rig, bone, axis, "fdda.state_range", "ADD")
            continue
        owner, prefix = (local_limit(bone, "LIMIT_ROTATION"), "") if r.source == CONSTRAINT else (bone, "ik_")
        fields.prop(owner, f"{prefix}min_{AXES[axis]}", text="")
        fields.prop(owner, f"{prefix}max_{AXES[axis]}", text="")
        _draw_state_button(fields, rig, bone, axis, "fdda.unstate_range", "X")
    locations = {} if bone.bone.use_connect else location_ranges(bone)
    for axis in locations:
        row = column.row(align=True)
        limit = local_limit(bone, "LIMIT_LOCATION")
        row.prop(bone, "lock_location", index=axis, text=f"Move {AXES[axis].upper()}", toggle=1)
        row.prop(limit, f"min_{AXES[axis]}", text="")
        row.prop(limit, f"max_{AXES[axis]}", text="")


def _draw_state_button(
    layout: bpy.types.UILayout, rig: SceneRig, bone: bpy.types.PoseBone, axis: int, operator: str, icon: str
) -> None:
    properties = layout.operator(operator, text="", icon=icon)
    properties.object, properties.bone, properties.axis = rig.mesh_object.name, bone.name, AXES[axis].upper()
    if operator == FDDA_OT_state_range.bl_idname:
        # Blender would take what was stated last.
        properties.low, properties.high = -math.pi / 4, math.pi / 4


def _draw_random(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    settings, number = rig.mesh_object.fdda.settings, context.window_manager.fdda.pose_number
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    column.prop(settings, "poses", text="Random Poses")
    column.prop(settings, "seed")
    column.prop(settings, "spread")
    row = layout.row(align=True)
    row.operator("fdda.preview_pose", text="", icon="TRIA_LEFT").step = -1
    row.operator("fdda.preview_pose", text=f"Show Pose {number}").step = 0
    row.operator("fdda.preview_pose", text="", icon="TRIA_RIGHT").step = 1
    row.separator()
    row.operator("fdda.rest_pose", text="Rest Pose", icon="LOOP_BACK")


def _draw_actions(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    fitting = [action for action in bpy.data.actions if fits_now(action, rig.armature_object)]
    if not fitting:
        return
    layout.label(text="Actions to record as well")
    session = context.window_manager.fdda
    layout.template_list("FDDA_UL_actions", "", bpy.data, "actions", session, "action_index", rows=min(4, len(fitting)))
    settings = rig.mesh_object.fdda.settings
    column = layout.column()
    column.enabled = any(action.fdda.record for action in fitting)
    column.prop(settings, "mirror")
    column.operator("fdda.limits_from_actions", icon="CON_ROTLIMIT")
    if not settings.poses and not any(action.fdda.record for action in fitting):
        draw_sentence(
            layout, context, "There is nothing to record: raise the number of poses, or tick an action.", "ERROR"
        )


CLASSES = (FDDA_UL_joints, sampled.FDDA_UL_controls, FDDA_UL_actions, FDDA_PT_poses)
