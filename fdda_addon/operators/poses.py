# SPDX-License-Identifier: GPL-3.0-or-later
"""The poses: look at those that are recorded, and state the range of motion."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import bpy

from ..core.errors import RigError
from ..properties.choices import recorded_actions, recording_settings
from ..scene.scene_rig import SceneRig
from .on_pose import OnPose

if TYPE_CHECKING:  # Blender starts without numpy.
    from ..core.controls import Control


class FDDA_OT_preview_pose(OnPose, bpy.types.Operator):
    bl_idname = "fdda.preview_pose"
    bl_label = "Show Random Pose"
    bl_description = "Pose the rig as one of the random poses that are recorded"
    bl_options = {"REGISTER", "UNDO"}

    number: bpy.props.IntProperty(
        name="Number",
        description="Of the pose; -1 for the one that was shown last",
        default=-1,
        min=-1,
        options={"SKIP_SAVE"},
    )
    step: bpy.props.IntProperty(
        name="Step", description="Show the pose so many after the number", options={"SKIP_SAVE"}
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        if properties.step:
            return f"Show the {'next' if properties.step > 0 else 'previous'} of the random poses that are recorded"
        return cls.bl_description

    def change(self, context: bpy.types.Context) -> str:
        from ..core.poses import sample_pose
        from ..recording.plan import read_sampled_rig
        from ..scene.armature import Poser, clear_pose

        rig = self.rig(context)
        settings, session = rig.mesh_object.fdda.settings, context.window_manager.fdda
        wanted = recording_settings(rig)
        _, channels = read_sampled_rig(rig, replace(wanted, poses=max(1, wanted.poses)))
        start = self.number if self.number >= 0 else session.pose_number
        number = max(0, start + self.step)
        clear_pose(rig.armature_object)
        Poser(rig, channels).set(sample_pose(channels, settings.seed, number, settings.spread))
        rig.armature_object.update_tag(refresh={"DATA"})
        session.pose_number = number
        return f"Random pose {number} of seed {settings.seed}."


class FDDA_OT_rest_pose(OnPose, bpy.types.Operator):
    bl_idname = "fdda.rest_pose"
    bl_label = "Rest Pose"
    bl_description = (
        "Bring every bone back to its rest pose, and every control that is sampled to where it does nothing"
    )
    bl_options = {"REGISTER", "UNDO"}

    def change(self, context: bpy.types.Context) -> str:
        from ..scene.armature import clear_pose
        from ..scene.control_names import control_default
        from ..scene.controls import is_driven, owner_of, set_control

        rig = self.rig(context)
        clear_pose(rig.armature_object)
        for control in _sampled_controls(rig):
            if not is_driven(owner_of(rig, control.owner), control.path):
                set_control(rig, control.name, control_default(rig, control.name))
        return f"'{rig.armature_object.name}' is in its rest pose."


def _sampled_controls(rig: SceneRig) -> "tuple[Control, ...]":
    """The controls that random poses change; none while the choice is not complete, which the section Rig says."""
    from ..recording.plan import read_sampling_choice

    try:
        return read_sampling_choice(rig, recording_settings(rig))[0].controls
    except RigError:
        return ()


class _OnRange(OnPose):
    """Mixin for an operator that changes the range of one rotation axis."""

    bone: bpy.props.StringProperty(name="Bone", description="Name of the bone", options={"SKIP_SAVE"})
    axis: bpy.props.EnumProperty(
        name="Axis", description="Of the rotation, in the bone's local space", items=[(a, a, "") for a in "XYZ"]
    )

    def pose_bone(self, context: bpy.types.Context) -> bpy.types.PoseBone:
        """The bone that is meant.

        Raises:
            RigError: there is none of this name.
        """
        armature_object = self.rig(context).armature_object
        bone = armature_object.pose.bones.get(self.bone)
        if bone is None:
            raise RigError(f"'{armature_object.name}' has no bone '{self.bone}'; give the name of one.")
        return bone

    @property
    def axis_index(self) -> int:
        return "XYZ".index(self.axis)


class FDDA_OT_state_range(_OnRange, bpy.types.Operator):
    bl_idname = "fdda.state_range"
    bl_label = "State Range"
    bl_description = (
        "Write this range of motion to the bone: as IK limits, or into its Limit Rotation constraint where it has one"
    )
    bl_options = {"REGISTER", "UNDO"}

    low: bpy.props.FloatProperty(
        name="Minimum", subtype="ANGLE", default=-math.pi / 4, min=-math.pi, max=math.pi, description="Lowest angle"
    )
    high: bpy.props.FloatProperty(
        name="Maximum", subtype="ANGLE", default=math.pi / 4, min=-math.pi, max=math.pi, description="Highest angle"
    )

    def change(self, context: bpy.types.Context) -> str:
        from ..poses.motion_range import set_rotation_range

        bone = self.pose_bone(context)
        set_rotation_range(bone, self.axis_index, self.low, self.high)
        low, high = math.degrees(self.low), math.degrees(self.high)
        return f"'{bone.name}' turns about {self.axis} from {low:.0f}° to {high:.0f}°."


class FDDA_OT_unstate_range(_OnRange, bpy.types.Operator):
    bl_idname = "fdda.unstate_range"
    bl_label = "Forget Range"
    bl_description = "Remove this range of motion from the bone; it then has the default of ±45°"
    bl_options = {"REGISTER", "UNDO"}

    def change(self, context: bpy.types.Context) -> str:
        from ..poses.motion_range import clear_rotation_range

        bone = self.pose_bone(context)
        clear_rotation_range(bone, self.axis_index)
        return f"'{bone.name}' states no range about {self.axis} any more."


class FDDA_OT_limits_from_actions(OnPose, bpy.types.Operator):
    bl_idname = "fdda.limits_from_actions"
    bl_label = "Set Limits from Actions"
    bl_description = (
        "Make how far the ticked actions move each bone its range of motion. Posing stays free: what IK limits cannot "
        "say goes into Limit constraints without influence"
    )
    bl_options = {"REGISTER", "UNDO"}

    margin: bpy.props.FloatProperty(
        name="Margin",
        description="Part of the width of a range that is added at each end",
        default=0.1,
        min=0.0,
        max=10.0,
    )

    def change(self, context: bpy.types.Context) -> str:
        from ..poses.measured_limits import set_limits_from_actions

        rig = self.rig(context)
        names = recorded_actions(rig.armature_object)
        if not names:
            raise RigError("No action is ticked; tick those of Actions to record as well that show how the rig moves.")
        limits = set_limits_from_actions(rig, [bpy.data.actions[name] for name in names], self.margin)
        stated = {limit.bone for limit in limits if not limit.reason_unset}
        left = [limit for limit in limits if limit.reason_unset]
        others = f"; {len(left)} axes were left as they are ('{left[0].bone}' {left[0].reason_unset})" if left else ""
        if wide := list(dict.fromkeys(limit.bone for limit in limits if limit.near_gimbal_lock)):
            others += f"; {len(wide)} ('{wide[0]}') rotate near gimbal lock, less far than these say: Ticked Actions,"
            others += " above the list, samples what the actions do"
        return f"{len(stated)} bones have the ranges of {', '.join(names)}{others}."


CLASSES = (
    FDDA_OT_preview_pose,
    FDDA_OT_rest_pose,
    FDDA_OT_state_range,
    FDDA_OT_unstate_range,
    FDDA_OT_limits_from_actions,
)
