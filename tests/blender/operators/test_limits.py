# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that set, copy, mirror and clear the rotation limits of several bones, and that set human limits."""

import math

import bpy
import pytest
from mathutils import Vector

from fdda_addon.poses.human_ranges import body_part_of, human_ranges
from fdda_addon.poses.motion_range import DEFAULT, rotation_ranges
from fdda_addon.properties import recording_options
from fdda_addon.scene.active_rig import active_rig
from fdda_addon.scene.compatibility import is_selected, select_bone

BONES = {
    "Hips": ((0, 0, 1.0), (0, 0, 1.1)),
    "LeftArm": ((0.2, 0, 1.4), (0.5, 0, 1.4)),
    "LeftForeArm": ((0.5, 0, 1.4), (0.8, 0, 1.4)),
    "RightArm": ((-0.2, 0, 1.4), (-0.5, 0, 1.4)),
    "RightForeArm": ((-0.5, 0, 1.4), (-0.8, 0, 1.4)),
    "tail": ((0, 0.2, 1.0), (0, 0.5, 1.0)),
}


@pytest.fixture
def armature_object() -> bpy.types.Object:
    """A small person in a T pose, with a mesh on the armature."""
    armature = bpy.data.armatures.new("person")
    armature_object = bpy.data.objects.new("person", armature)
    mesh_object = bpy.data.objects.new("body", bpy.data.meshes.new("body"))
    for o in (armature_object, mesh_object):
        bpy.context.scene.collection.objects.link(o)
    mesh_object.modifiers.new("Armature", "ARMATURE").object = armature_object
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    for name, (head, tail) in BONES.items():
        bone = armature.edit_bones.new(f"mixamorig:{name}")
        bone.head, bone.tail = head, tail
        bone.align_roll(Vector((0, 0, 1)) if "Arm" in name else Vector((0, -1, 0)))
    bpy.ops.object.mode_set(mode="POSE")
    return armature_object


def bone(armature_object: bpy.types.Object, name: str) -> bpy.types.PoseBone:
    return armature_object.pose.bones[f"mixamorig:{name}"]


def select(armature_object: bpy.types.Object, *names: str) -> None:
    for each in armature_object.pose.bones:
        select_bone(each, each.name.partition(":")[2] in names)
        assert is_selected(each) == (each.name.partition(":")[2] in names)


def degrees(pose_bone: bpy.types.PoseBone) -> list[tuple[float, float]]:
    return [(round(math.degrees(r.low)), round(math.degrees(r.high))) for r in rotation_ranges(pose_bone)]


def test_limits_of_all_selected_bones_are_set(armature_object):
    select(armature_object, "LeftArm", "tail")
    low, high = (math.radians(-10), 0, math.radians(-30)), (math.radians(20), 1, math.radians(5))
    assert bpy.ops.fdda.set_limits(axes=(True, False, True), low=low, high=high) == {"FINISHED"}
    for name in ("LeftArm", "tail"):
        assert degrees(bone(armature_object, name)) == [(-10, 20), (-45, 45), (-30, 5)]
    assert all(r.source == DEFAULT for r in rotation_ranges(bone(armature_object, "Hips")))
    with pytest.raises(RuntimeError, match="The maximum about X must be larger than the minimum"):
        bpy.ops.fdda.set_limits(low=high, high=low)


def test_limits_are_copied_mirrored_and_cleared(armature_object):
    select(armature_object, "LeftArm")
    low, high = ([math.radians(v) for v in values] for values in ((-10, -20, -30), (1, 2, 3)))
    bpy.ops.fdda.set_limits(low=low, high=high)
    assert bpy.ops.fdda.mirror_limits() == {"FINISHED"}
    assert degrees(bone(armature_object, "RightArm")) == [(-10, 1), (-2, 20), (-3, 30)]
    select(armature_object, "tail", "Hips")
    assert bpy.ops.fdda.copy_limits(bone="mixamorig:LeftArm") == {"FINISHED"}
    assert degrees(bone(armature_object, "tail")) == degrees(bone(armature_object, "LeftArm"))
    assert bpy.ops.fdda.clear_limits() == {"FINISHED"}
    assert all(r.source == DEFAULT for r in rotation_ranges(bone(armature_object, "tail")))
    select(armature_object, "tail")
    with pytest.raises(RuntimeError, match="No selected bone has a bone of the same name on the other side"):
        bpy.ops.fdda.mirror_limits()


def test_the_automatic_choice_of_bones_follows_the_limits(armature_object, monkeypatch):
    """As in a window, where an unchanged action is not read again."""
    monkeypatch.setattr(recording_options, "actions_state", lambda: None)
    rig = active_rig(bpy.context)
    pose_bone = bone(armature_object, "tail")
    for frame, angle in ((1, 0.0), (10, 0.5)):
        pose_bone.rotation_mode, pose_bone.rotation_euler = "XYZ", (angle, 0, 0)
        pose_bone.keyframe_insert("rotation_euler", frame=frame)
    for each in bpy.data.actions:
        each.fdda.record = False
    assert recording_options.bones_to_pose(rig) == "REMIX"
    select(armature_object, "tail")
    bpy.ops.fdda.set_limits()
    assert recording_options.bones_to_pose(rig) == "WEIGHTS"
    bpy.ops.fdda.clear_limits()
    assert recording_options.bones_to_pose(rig) == "REMIX"


def test_operators_without_selected_bones_are_refused(armature_object):
    select(armature_object)
    for operator in (bpy.ops.fdda.set_limits, bpy.ops.fdda.mirror_limits, bpy.ops.fdda.clear_limits):
        with pytest.raises(RuntimeError, match="No bone of 'person' is selected; check bones in the list"):
            operator()


def test_human_limits_are_set_for_body_parts_only(armature_object):
    assert bpy.ops.fdda.human_limits() == {"FINISHED"}
    assert all(r.source == DEFAULT for r in rotation_ranges(bone(armature_object, "tail")))
    # Forearms bend by a rotation about the Z axis of the body.
    for side, sign in (("Left", 1), ("Right", -1)):
        found = human_ranges(armature_object, bone(armature_object, f"{side}ForeArm").bone)
        axes = bone(armature_object, f"{side}ForeArm").bone.matrix_local.to_3x3().transposed()
        folding = max(range(3), key=lambda axis: abs(axes[axis].z))
        turned = axes[folding].z * sign * -1
        low, high = (round(math.degrees(v)) for v in found[folding])
        assert {low, high} == {0, 120 if turned > 0 else -120} or {low, high} == {0, -120 if turned < 0 else 120}
    with pytest.raises(RuntimeError, match="No bone of 'person' without limits has the name of a body part"):
        bpy.ops.fdda.human_limits()
    assert bpy.ops.fdda.human_limits(replace=True) == {"FINISHED"}


@pytest.mark.parametrize(
    ("name", "side"),
    [
        ("mixamorig:LeftForeArm", "left"),
        ("DEF-forearm.R", "right"),
        ("upper_arm.L", "left"),
        ("CC_Base_L_Thigh", "left"),
        ("Bip01 R Calf", "right"),
        ("hand_r", "right"),
        ("f_index.01.L", "left"),
        ("RightHandThumb2", "right"),
        ("spine.003", ""),
        ("Head", ""),
    ],
)
def test_bones_are_recognized_as_body_parts_by_name(name, side):
    ranges, found = body_part_of(name)
    assert ranges is not None and found == side


@pytest.mark.parametrize("name", ["tail", "skirt_01.L", "armor", "eye.L", "IK_target", "Bone.001"])
def test_other_bones_are_no_body_parts(name):
    assert body_part_of(name)[0] is None
