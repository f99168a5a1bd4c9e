# SPDX-License-Identifier: GPL-3.0-or-later
"""State of the sidebar: `WindowManager.fdda`, which is not saved in the .blend file."""

from contextlib import suppress

import bpy
from bpy.props import BoolProperty, IntProperty, PointerProperty, StringProperty

from ..core.errors import FDDAError
from ..jobs.job import current
from ..recording.pose_plan import show_random_pose, show_rest_pose
from ..scene import undo
from ..scene.active_rig import cached_active_rig
from .character import not_animatable
from .recording_options import complete_settings, recording_settings


def _show_random_pose(session: "FDDA_PG_session", number: int) -> None:
    """Show the random pose with the number that was entered in the sidebar: 1 is the first, 0 is the rest pose."""
    context, job = bpy.context, current()
    rig = cached_active_rig(context)
    if rig is None or context.mode not in {"OBJECT", "POSE"} or (job is not None and job.changes_scene):
        return
    # If no random pose can be shown, the section Rig shows the reason.
    with suppress(FDDAError):
        if number:
            session.pose_index = show_random_pose(rig, recording_settings(rig), number - 1)
        else:
            show_rest_pose(rig, complete_settings(rig))
            session.pose_index = -1
        undo.push_undo_soon("Preview Pose")


def _active_bone_index(_session: "FDDA_PG_session") -> int:
    """Return the index of the bone that is active in the viewport; -1 without one."""
    rig = cached_active_rig(bpy.context)
    active_bone = rig.armature_object.data.bones.active if rig is not None else None
    return rig.armature_object.pose.bones.find(active_bone.name) if active_bone is not None else -1


def _set_active_bone(_session: "FDDA_PG_session", index: int) -> None:
    """Make a bone active in the viewport."""
    rig = cached_active_rig(bpy.context)
    if rig is not None and 0 <= index < len(rig.armature_object.pose.bones):
        rig.armature_object.data.bones.active = rig.armature_object.pose.bones[index].bone


@not_animatable
class FDDA_PG_session(bpy.types.PropertyGroup):
    """State of the sidebar: the shown mesh, the active entries of lists, and the previewed pose."""

    mesh: StringProperty(name="Mesh", description="Mesh of the active armature that the sidebar shows")

    pose_index: IntProperty(
        name="Pose Index", description="Index of the random pose that is shown; -1 before the first", default=-1, min=-1
    )
    preview_pose: IntProperty(
        name="Preview Pose",
        description="Show one of the random poses that will be recorded. 0 for the rest pose",
        min=0,
        get=lambda session: session.pose_index + 1,
        set=_show_random_pose,
    )
    bone_index: IntProperty(
        name="Bone", description="Active bone of the armature", get=_active_bone_index, set=_set_active_bone
    )
    action_index: IntProperty(name="Action")
    show_all_partitions: BoolProperty(
        name="Show All", description="List all body parts of the model, not only the worst"
    )


CLASSES = (FDDA_PG_session,)
PROPERTIES = {(bpy.types.WindowManager, "fdda"): PointerProperty(type=FDDA_PG_session)}


def unregister() -> None:
    """Cancel the undo step of a previewed pose."""
    undo.cancel_push()
