# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators on the rotation limits of bones."""

import math

import bpy

from ..core.errors import RigError
from ..core.wording import format_count
from ..poses.clip_player import flipped_name
from ..poses.human_ranges import human_ranges
from ..poses.motion_range import DEFAULT, clear_rotation_range, rotation_ranges, set_rotation_range
from ..scene import draw_cache
from ..scene.compatibility import is_selected
from .rig_operator import OBJECT_OR_POSE_MODE, RigOperator

AXES = "XYZ"


class _LimitsOperator(RigOperator):
    """Mixin for an operator that changes limits."""

    modes = OBJECT_OR_POSE_MODE

    def execute(self, context: bpy.types.Context) -> set[str]:
        result = super().execute(context)
        draw_cache.clear()
        return result


class _SelectedBonesOperator(_LimitsOperator):
    """Mixin for an operator on the limits of the selected bones."""

    def selected_bones(self, context: bpy.types.Context) -> list[bpy.types.PoseBone]:
        """Return the selected bones.

        Raises:
            RigError: no bone is selected.
        """
        armature_object = self.rig(context).armature_object
        bones = [bone for bone in armature_object.pose.bones if is_selected(bone)]
        if not bones:
            raise RigError(
                f"No bone of '{armature_object.name}' is selected; check bones in the list or select them in Pose Mode."
            )
        return bones


class _AxesOperator(_SelectedBonesOperator):
    """Mixin for an operator on the limits about some axes, of one bone or of the selected bones."""

    bone: bpy.props.StringProperty(
        name="Bone", description="Name of the bone. Empty for the selected bones", options={"SKIP_SAVE"}
    )
    axes: bpy.props.BoolVectorProperty(
        name="Axes", description="Axes of the rotation, in local space", default=(True,) * 3, options={"SKIP_SAVE"}
    )
    bone_description = ""
    """Description of a button for one bone."""

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return cls.bone_description if properties.bone else cls.bl_description

    def bones(self, context: bpy.types.Context) -> list[bpy.types.PoseBone]:
        """Return the bones to apply the operator to.

        Raises:
            RigError: there is no bone of this name, or no bone is selected.
        """
        if not self.bone:
            return self.selected_bones(context)
        armature_object = self.rig(context).armature_object
        bone = armature_object.pose.bones.get(self.bone)
        if bone is None:
            raise RigError(f"'{armature_object.name}' has no bone '{self.bone}'; give the name of one.")
        return [bone]

    def format_bones(self, bones: list[bpy.types.PoseBone]) -> str:
        """Return what the message calls the bones that `bones` has returned."""
        if not self.bone:
            return format_count(len(bones), "bone")
        return f"'{self.bone}' about {', '.join(AXES[axis] for axis in range(3) if self.axes[axis])}"


def _copy_limits(from_bone: bpy.types.PoseBone, to_bone: bpy.types.PoseBone, is_mirrored: bool = False) -> None:
    """Copy the rotation limits of one bone to another. Mirroring negates the limits about Y and Z."""
    for axis, limit in enumerate(rotation_ranges(from_bone)):
        is_negated = is_mirrored and axis > 0
        low, high = (-limit.high, -limit.low) if is_negated else (limit.low, limit.high)
        if limit.source == DEFAULT:
            clear_rotation_range(to_bone, axis)
        elif low < high:
            set_rotation_range(to_bone, axis, low, high)
        to_bone.lock_rotation[axis] = limit.is_locked or low >= high


class FDDA_OT_set_limits(_AxesOperator, bpy.types.Operator):
    bl_idname = "fdda.set_limits"
    bl_label = "Set Limits"
    bl_description = "Give all selected bones the same rotation limits"
    bone_description = "Give the bone rotation limits about this axis. The default is ±45°"

    low: bpy.props.FloatVectorProperty(
        name="Minimum", subtype="EULER", default=(-math.pi / 4,) * 3, min=-math.pi, max=math.pi
    )
    high: bpy.props.FloatVectorProperty(
        name="Maximum", subtype="EULER", default=(math.pi / 4,) * 3, min=-math.pi, max=math.pi
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if self.bone:
            return self.execute(context)
        try:
            ranges = rotation_ranges(self.selected_bones(context)[0])
        except RigError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.low, self.high = [r.low for r in ranges], [r.high for r in ranges]
        self.axes = [r.moves for r in ranges]
        return context.window_manager.invoke_props_dialog(
            self, title="Set Limits of Selected Bones", confirm_text="Set"
        )

    def draw(self, _context: bpy.types.Context) -> None:
        for axis, letter in enumerate(AXES):
            row = self.layout.row(align=True)
            row.prop(self, "axes", index=axis, text=letter, toggle=True)
            fields = row.row(align=True)
            fields.active = self.axes[axis]
            fields.prop(self, "low", index=axis, text="")
            fields.prop(self, "high", index=axis, text="")

    def apply(self, context: bpy.types.Context) -> str:
        bones = self.bones(context)
        for axis in (axis for axis in range(3) if self.axes[axis]):
            if not self.low[axis] < self.high[axis]:
                raise RigError(f"The maximum about {AXES[axis]} must be larger than the minimum.")
        for bone in bones:
            for axis in (axis for axis in range(3) if self.axes[axis]):
                set_rotation_range(bone, axis, self.low[axis], self.high[axis])
        return f"Set the limits of {self.format_bones(bones)}."


class FDDA_OT_copy_limits(_SelectedBonesOperator, bpy.types.Operator):
    bl_idname = "fdda.copy_limits"
    bl_label = "Copy Limits to Selected Bones"
    bl_description = "Copy the limits of the active bone of the list to the selected bones"

    bone: bpy.props.StringProperty(
        name="Bone", description="Bone to copy from. Empty for the active bone of the list", options={"SKIP_SAVE"}
    )

    def apply(self, context: bpy.types.Context) -> str:
        bones = self.rig(context).armature_object.pose.bones
        index = context.window_manager.fdda.bone_index
        source = bones.get(self.bone) if self.bone else (bones[index] if 0 <= index < len(bones) else None)
        if source is None:
            raise RigError(f"There is no bone '{self.bone}' to copy from; click one in the list.")
        targets = [bone for bone in self.selected_bones(context) if bone != source]
        for target in targets:
            _copy_limits(source, target)
        return f"Copied the limits of '{source.name}' to {format_count(len(targets), 'bone')}."


class FDDA_OT_mirror_limits(_SelectedBonesOperator, bpy.types.Operator):
    bl_idname = "fdda.mirror_limits"
    bl_label = "Mirror Limits to Other Side"
    bl_description = "Copy the limits of the selected bones, mirrored, to the bones of the other side"

    def apply(self, context: bpy.types.Context) -> str:
        bones = self.rig(context).armature_object.pose.bones
        pairs = [(bone, bones.get(flipped_name(bone.name))) for bone in self.selected_bones(context)]
        pairs = [
            (bone, opposite_bone)
            for bone, opposite_bone in pairs
            if opposite_bone is not None and opposite_bone != bone
        ]
        if not pairs:
            raise RigError(
                "No selected bone has a bone of the same name on the other side; select bones such as arm.L or LeftArm."
            )
        for bone, opposite_bone in pairs:
            _copy_limits(bone, opposite_bone, is_mirrored=True)
        return f"Mirrored the limits of {format_count(len(pairs), 'bone')}."


class FDDA_OT_human_limits(_LimitsOperator, bpy.types.Operator):
    bl_idname = "fdda.human_limits"
    bl_label = "Human Limits"
    bl_description = (
        "Give all bones that are named after body parts (arm, forearm, thigh, spine, index1 …) the rotation limits of "
        "a person. The character must stand upright and face -Y"
    )

    only_selected: bpy.props.BoolProperty(name="Only Selected", description="Set the limits of selected bones only")
    replace: bpy.props.BoolProperty(name="Replace", description="Overwrite the limits of bones that already have some")

    def apply(self, context: bpy.types.Context) -> str:
        armature_object = self.rig(context).armature_object
        count = 0
        for bone in armature_object.pose.bones:
            if self.only_selected and not is_selected(bone):
                continue
            current_ranges = rotation_ranges(bone)
            human_limits = human_ranges(armature_object, bone.bone)
            if human_limits is None or not (self.replace or all(r.source == DEFAULT for r in current_ranges)):
                continue
            for axis, (low, high) in enumerate(human_limits):
                if low < high:
                    set_rotation_range(bone, axis, low, high)
                else:
                    bone.lock_rotation[axis] = True
            count += 1
        if not count:
            raise RigError(
                f"No bone of '{armature_object.name}' without limits has the name of a body part; set the limits by "
                "hand, or check actions."
            )
        return f"Set human limits for {format_count(count, 'bone')}."


class FDDA_OT_clear_limits(_AxesOperator, bpy.types.Operator):
    bl_idname = "fdda.clear_limits"
    bl_label = "Clear Limits"
    bl_description = "Remove the rotation limits of the selected bones. The default is ±45°"
    bone_description = "Remove the rotation limits of the bone about this axis. The default is ±45°"

    def apply(self, context: bpy.types.Context) -> str:
        bones = self.bones(context)
        for bone in bones:
            for axis in (axis for axis in range(3) if self.axes[axis]):
                clear_rotation_range(bone, axis)
        return f"Removed the limits of {self.format_bones(bones)}."


CLASSES = (
    FDDA_OT_set_limits,
    FDDA_OT_copy_limits,
    FDDA_OT_mirror_limits,
    FDDA_OT_human_limits,
    FDDA_OT_clear_limits,
)
