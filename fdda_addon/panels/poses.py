# SPDX-License-Identifier: GPL-3.0-or-later
"""Section "Training Poses": sets random poses, their limits, and the actions to record."""

import bpy

from ..core.settings import MAX_AUTO_POSES, POSES
from ..core.wording import format_list
from ..properties.recording_options import actions_of_rig, meshes_with_other_settings, recorded_actions
from ..scene.active_rig import cached_rigs_together
from ..scene.scene_rig import SceneRig
from . import limits, sampling
from .section import Section, draw_advanced, draw_wrapped, panel_rig


class FDDA_UL_actions(bpy.types.UIList):
    """List of the actions that animate the rig, each with a checkbox."""

    def filter_items(self, context: bpy.types.Context, data: object, name: str) -> tuple[list[int], list[int]]:
        rig = panel_rig(context)[0]
        text = self.filter_name.lower()
        flags = [
            self.bitflag_filter_item if rig and text in action.name.lower() and action in actions_of_rig(rig) else 0
            for action in getattr(data, name)
        ]
        return flags, []

    def draw_item(self, _context: bpy.types.Context, layout: bpy.types.UILayout, _data, action, _icon, _active, _name):
        row = layout.row()
        row.prop(action.fdda, "record", text="")
        row.label(text=action.name, icon="ACTION")
        first_frame, last_frame = (round(frame) for frame in action.frame_range)
        right_part = row.row()
        right_part.alignment = "RIGHT"
        right_part.label(text=f"{first_frame}…{last_frame}")


class FDDA_PT_poses(Section, bpy.types.Panel):
    bl_idname = "FDDA_PT_poses"
    bl_label = "Training Poses"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def is_done(cls, context: bpy.types.Context) -> bool:
        rig = panel_rig(context)[0]
        if rig is None or not _has_poses(rig):
            return False
        return not limits.lacks_limits(rig) and not limits.count_controlled_bones(rig)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.enabled_layout()
        rig = panel_rig(context)[0]
        if rig is None:
            return
        _draw_shared(layout, context, rig)
        layout.operator("fdda.human_limits", text="Human Limits (All Bones)", icon="OUTLINER_OB_ARMATURE")
        sampling.draw_bones_to_pose(layout, context, rig)
        _draw_table(layout, context, rig)
        row = layout.row(align=True)
        row.prop(context.window_manager.fdda, "preview_pose")
        row.operator("fdda.rest_pose", text="Rest Pose", icon="LOOP_BACK")
        # The action is the armature's, of all checked meshes.
        layout.operator("fdda.poses_to_action", icon="ACTION").all_meshes = bool(cached_rigs_together(context))
        # Draw the sentences that come and go, below the buttons, so that these do not move under the mouse.
        if not _has_poses(rig):
            draw_wrapped(layout, context, "Nothing to record: raise Random Poses, or check an action.", "ERROR")
        if limits.lacks_limits(rig):
            text = "No rotation limits found. Every bone will rotate ±45°; set limits, or press Human Limits."
            draw_wrapped(layout, context, text, "ERROR")
        sampling.draw_channel_counts(layout, context, rig)
        limits.draw_limits(layout, context, rig)
        sampling.draw_extra_inputs(layout, rig)
        if (advanced := draw_advanced(layout, "fdda_poses_advanced")) is not None:
            for name in ("seed", "spread", "overshoot"):
                advanced.prop(rig.mesh_object.fdda.settings, name)


def _draw_shared(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    """Say that the fields belong to all meshes that are recorded together, and which have other values until then."""
    mesh_objects = [each.mesh_object for each in cached_rigs_together(context)]
    if not mesh_objects:
        return
    layout.label(text=f"Shared by {len(mesh_objects)} Meshes", icon="LINKED")
    if names := meshes_with_other_settings(rig.mesh_object, mesh_objects):
        draw_wrapped(layout, context, f"Record replaces other settings of {format_list(names)}.", "INFO")


def _draw_table(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    """Draw what is recorded: the number of random poses, and the actions with their frames."""
    settings, session = rig.mesh_object.fdda.settings, context.window_manager.fdda
    box = layout.box().column()
    column = box.column()
    column.use_property_split, column.use_property_decorate = True, False
    # A heading belongs to one field; the name of a number is drawn beside it anyway.
    row = column.row(align=True, heading="Random Poses" if settings.auto_poses else "")
    if settings.auto_poses:
        row.prop(settings, "auto_poses", text=f"Auto ({POSES.default:,} to {MAX_AUTO_POSES:,})", toggle=1)
    else:
        row.prop(settings, "poses")
        row.prop(settings, "auto_poses", toggle=1)
    actions = actions_of_rig(rig)
    if not actions:
        return
    box.label(text="Also Record Actions")
    box.template_list("FDDA_UL_actions", "", bpy.data, "actions", session, "action_index", rows=min(4, len(actions)))
    row = box.row()
    # Only the frames of checked actions are mirrored.
    row.active = any(action.fdda.record for action in actions)
    row.prop(settings, "mirror")


def _has_poses(rig: SceneRig) -> bool:
    """Return whether there is something to record."""
    return rig.mesh_object.fdda.settings.has_random_poses or bool(recorded_actions(rig))


CLASSES = (limits.FDDA_UL_bones, sampling.FDDA_UL_controls, FDDA_UL_actions, FDDA_PT_poses)
