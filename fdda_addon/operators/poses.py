# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators on poses: reset the pose, make an action of poses, select bones."""

from collections.abc import Collection
from contextlib import ExitStack

import bpy

from ..core.errors import RigError
from ..core.progress import Job
from ..core.wording import format_count
from ..properties.recording_options import complete_settings, recording_settings
from ..recording.pose_plan import show_rest_pose
from ..recording.posed_action import make_posed_action
from ..runtime.binding import model_disabled
from ..scene.compatibility import select_bone
from ..scene.scene_rig import SceneRig
from .job import JobOperator
from .rig_operator import OBJECT_OR_POSE_MODE, RigOperator


class FDDA_OT_rest_pose(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.rest_pose"
    bl_label = "Rest Pose"
    bl_description = "Reset all bones to the rest pose, and all extra inputs of the random poses to their defaults"
    modes = OBJECT_OR_POSE_MODE

    def apply(self, context: bpy.types.Context) -> str:
        rig = self.rig(context)
        show_rest_pose(rig, complete_settings(rig))
        context.window_manager.fdda.pose_index = -1
        return f"'{rig.armature_object.name}' is in its rest pose."


class FDDA_OT_poses_to_action(JobOperator, bpy.types.Operator):
    bl_idname = "fdda.poses_to_action"
    bl_label = "Poses to Action"
    bl_description = (
        "Make an action with one training pose per frame, after the rest pose in frame 0, to export it for training in "
        "other programs. The scene gets its frames"
    )
    verb, title = "poses", "Poses to Action"
    changes_file = True

    def steps(self, context: bpy.types.Context) -> Job[tuple[bpy.types.Action, list[str]]]:
        character = self.character(context)
        with ExitStack() as stack:
            for mesh_object in character.mesh_objects:
                stack.enter_context(model_disabled(mesh_object))
            return (yield from make_posed_action(character, recording_settings(self.rig(context))))

    def finish(self, context: bpy.types.Context, result: tuple[bpy.types.Action, list[str]]) -> str:
        action, driven = result
        note = f" Keyed, with their drivers muted: {', '.join(driven)}." if driven else ""
        return f"The action '{action.name}' has {format_count(context.scene.frame_end, 'pose')}.{note}"


class FDDA_OT_show_bone(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.show_bone"
    bl_label = "Select Bone"
    bl_description = "Select this bone in Pose Mode"
    waits_for_jobs = False

    bone: bpy.props.StringProperty(name="Bone", description="Name of the bone", options={"SKIP_SAVE"})

    def apply(self, context: bpy.types.Context) -> str:
        armature_object = self.rig(context).armature_object
        bone = armature_object.pose.bones.get(self.bone)
        if bone is None:
            raise RigError(f"'{armature_object.name}' has no bone '{self.bone}'.")
        select_bones(context, self.rig(context), {self.bone})
        return ""


def select_bones(context: bpy.types.Context, rig: SceneRig, names: Collection[str]) -> None:
    """Select bones in Pose Mode, and deselect the others."""
    armature_object = rig.armature_object
    if context.mode != "POSE":
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        context.view_layer.objects.active = armature_object
        bpy.ops.object.mode_set(mode="POSE")
        context.window_manager.fdda.mesh = rig.mesh_object.name
    for bone in armature_object.pose.bones:
        select_bone(bone, bone.name in names)
        if bone.name in names:
            armature_object.data.bones.active = bone.bone


CLASSES = (
    FDDA_OT_rest_pose,
    FDDA_OT_poses_to_action,
    FDDA_OT_show_bone,
)
