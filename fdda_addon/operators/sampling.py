# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that choose the bones and extra inputs of random poses."""

from dataclasses import replace

import bpy

from ..core.errors import RigError
from ..poses.sample_selection import describe_control_bones
from ..properties.recording_options import recorded_actions, recording_settings
from ..recording.plan import RecordingSettings, listed_controls
from ..scene.compatibility import is_selected
from ..scene.controls import control_at
from .rig_operator import OBJECT_OR_POSE_MODE, RigOperator


class FDDA_OT_use_selected_bones(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.use_selected_bones"
    bl_label = "Use Selected Bones"
    bl_description = (
        "Let random poses move the bones that are selected now. Later changes of the selection have no effect"
    )
    modes = OBJECT_OR_POSE_MODE

    def apply(self, context: bpy.types.Context) -> str:
        rig = self.rig(context)
        names = [bone.name for bone in rig.armature_object.pose.bones if is_selected(bone)]
        if not names:
            raise RigError(f"No bone of '{rig.armature_object.name}' is selected; select bones in Pose Mode.")
        settings = rig.mesh_object.fdda.settings
        settings.bones_to_pose = "SELECTED"
        settings.sampled_bones.clear()
        for name in names:
            settings.sampled_bones.add().name = name
        return (
            f"Random poses move {len(names)} {'bone' if len(names) == 1 else 'bones'} of '{rig.armature_object.name}'."
        )


class FDDA_OT_add_control(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.add_control"
    bl_label = "Add Extra Input"
    bl_description = "Make a shape key or another animated number an input of the model. Random poses change it too"
    modes = OBJECT_OR_POSE_MODE

    name: bpy.props.StringProperty(
        name="Name", description="Name of a shape key, or data path. Empty to choose it later", options={"SKIP_SAVE"}
    )

    def apply(self, context: bpy.types.Context) -> str:
        rig = self.rig(context)
        settings = rig.mesh_object.fdda.settings
        name = control_at(rig, self.name)
        if name:
            try:
                recording_options = recording_settings(rig)
            except RigError:
                # The bones to pose have not been chosen yet.
                recording_options = RecordingSettings()
            listed_controls(rig, replace(recording_options, extra_inputs=(name,)))
        if name and name in settings.extra_inputs:
            raise RigError(f"'{name}' is already in the list.")
        settings.extra_inputs.add().name = name
        settings.extra_input_index = len(settings.extra_inputs) - 1
        return f"Added {name or 'an input'}."


class FDDA_OT_add_control_bones(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.add_control_bones"
    bl_label = "Add Bones as Controls"
    bl_description = (
        "Make the unlocked channels and custom properties of the selected bones inputs of the model, for control bones "
        "that deform the mesh other than through its deforming bones. Random poses move them too"
    )
    modes = OBJECT_OR_POSE_MODE

    def apply(self, context: bpy.types.Context) -> str:
        rig = self.rig(context)
        settings = rig.mesh_object.fdda.settings
        names = [f"bone:{bone.name}" for bone in rig.armature_object.pose.bones if is_selected(bone)]
        if not names:
            raise RigError(f"No bone of '{rig.armature_object.name}' is selected; select control bones in Pose Mode.")
        new_names = [name for name in names if name not in settings.extra_inputs]
        if not new_names:
            raise RigError("The selected bones are already in the list.")
        actions = recorded_actions(rig)
        controls = listed_controls(rig, RecordingSettings(extra_inputs=tuple(new_names), actions=actions))
        for name in new_names:
            settings.extra_inputs.add().name = name
        settings.extra_input_index = len(settings.extra_inputs) - 1
        bone_names = [name.removeprefix("bone:") for name in new_names]
        return f"Added {describe_control_bones(rig.armature_object, bone_names, controls)}"


class FDDA_OT_remove_control(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.remove_control"
    bl_label = "Remove Extra Input"
    bl_description = "Remove the active input from the list"
    modes = OBJECT_OR_POSE_MODE

    def apply(self, context: bpy.types.Context) -> str:
        settings = self.rig(context).mesh_object.fdda.settings
        index = settings.extra_input_index
        if not 0 <= index < len(settings.extra_inputs):
            raise RigError("No extra input is active; click one in the list.")
        name = settings.extra_inputs[index].name
        settings.extra_inputs.remove(index)
        settings.extra_input_index = max(0, index - 1)
        return f"Removed {name or 'the input'}."


CLASSES = (FDDA_OT_use_selected_bones, FDDA_OT_add_control, FDDA_OT_add_control_bones, FDDA_OT_remove_control)
