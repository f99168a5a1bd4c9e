# SPDX-License-Identifier: GPL-3.0-or-later
"""Build characters that bones of a second armature deform; each function builds one in the current scene."""

import bpy

from . import stacks
from .base import link, tube
from .bones import NewBone, add_bones, limit
from .controls import add_cast
from .skinning import two_armatures

ARMATURE, BONE = "muscle_rig", "muscle"


def muscle_bone() -> bpy.types.PoseBone:
    """Return the pose bone of the second armature."""
    return bpy.data.objects[ARMATURE].pose.bones[BONE]


def quaternion() -> None:
    two_armatures()
    muscle_bone().rotation_mode = "QUATERNION"


def axis_angle() -> None:
    two_armatures()
    muscle_bone().rotation_mode = "AXIS_ANGLE"


def free_location() -> None:
    two_armatures()
    muscle_bone().lock_location[2] = False


def free_scale() -> None:
    two_armatures()
    muscle_bone().lock_scale = (False, False, False)


def free_root() -> None:
    """The parent of the deforming bone is a non-deforming bone without limits."""
    two_armatures()
    armature_object = bpy.data.objects[ARMATURE]
    add_bones(armature_object, NewBone("root", (0.1, 0.0, -0.1), (0.1, 0.0, 0.0), is_deforming=False))
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    armature_object.data.edit_bones[BONE].parent = armature_object.data.edit_bones["root"]
    bpy.ops.object.mode_set(mode="OBJECT")
    armature_object.pose.bones["root"].lock_rotation = (False, False, False)
    armature_object.pose.bones["root"].rotation_mode = "QUATERNION"


def hook_on_a_bone() -> None:
    stacks.hook()
    handle = bpy.data.objects["handle"]
    matrix = handle.matrix_world.copy()
    handle.parent, handle.parent_type, handle.parent_bone = add_unlocked_armature(), "BONE", BONE
    bpy.context.view_layer.update()
    handle.matrix_world = matrix


def hook_that_copies_a_bone() -> None:
    stacks.hook()
    handle = bpy.data.objects["handle"]
    handle.parent = None
    copy = handle.constraints.new("COPY_TRANSFORMS")
    copy.target, copy.subtarget = add_unlocked_armature(), BONE


def lattice_on_a_bone() -> None:
    stacks.lattice()
    lattice_object = bpy.data.objects["lattice"]
    lattice_object.vertex_groups.new(name=BONE).add(range(54), 1.0, "REPLACE")
    lattice_object.modifiers.new("Muscles", "ARMATURE").object = add_unlocked_armature()


def driver_of_a_bone() -> None:
    """A driver of a modifier reads the rotation of a bone."""
    _drive_by_bone_transform("ROT_X")


def driver_of_a_channel() -> None:
    """A driver of a modifier reads a component of a bone's quaternion, although a constraint replaces the rotation."""
    mesh_object, rig = tube()
    armature_object = add_unlocked_armature()
    constraint = armature_object.pose.bones[BONE].constraints.new("COPY_ROTATION")
    constraint.target, constraint.subtarget = rig, "lower"
    driver = add_cast(mesh_object).driver_add("factor").driver
    variable = driver.variables.new()
    variable.name, variable.targets[0].id = "x", armature_object
    variable.targets[0].data_path = f'pose.bones["{BONE}"].rotation_quaternion[1]'
    driver.expression = "x"


def limited_location() -> None:
    two_armatures()
    limit(muscle_bone(), "LIMIT_LOCATION", {2: (-0.02, 0.02)})


def copied_from_the_first() -> None:
    """The unlocked bone copies the transforms of a non-deforming bone of the first armature."""
    two_armatures()
    armature_object = bpy.data.objects["elbow_rig"]
    add_bones(armature_object, NewBone("handle", (0.1, 0.0, 0.0), (0.1, 0.0, 0.1), is_deforming=False))
    limit(armature_object.pose.bones["handle"], "LIMIT_ROTATION", {0: (-20.0, 20.0)})
    _unlock(muscle_bone())
    copy = muscle_bone().constraints.new("COPY_TRANSFORMS")
    copy.target, copy.subtarget = armature_object, "handle"


def add_unlocked_armature() -> bpy.types.Object:
    """Add a second armature with Blender's defaults: quaternion rotation and no locks."""
    armature_object = link(bpy.data.objects.new(ARMATURE, bpy.data.armatures.new(ARMATURE)))
    add_bones(armature_object, NewBone(BONE, (0.1, 0.0, 0.0), (0.1, 0.0, 0.1)))
    _unlock(armature_object.pose.bones[BONE])
    return armature_object


def _unlock(pose_bone: bpy.types.PoseBone) -> None:
    pose_bone.rotation_mode = "QUATERNION"
    pose_bone.lock_location = pose_bone.lock_rotation = pose_bone.lock_scale = (False, False, False)


def _drive_by_bone_transform(channel: str) -> None:
    mesh_object, _ = tube()
    driver = add_cast(mesh_object).driver_add("factor").driver
    variable = driver.variables.new()
    variable.name, variable.type = "transform", "TRANSFORMS"
    target = variable.targets[0]
    target.id, target.bone_target, target.transform_type = add_unlocked_armature(), BONE, channel
    target.transform_space = "LOCAL_SPACE"
    driver.expression = "transform"
