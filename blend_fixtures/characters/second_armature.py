# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters that bones of a second armature deform: one function each, which builds it in the current scene.

Of `REFUSED` the second armature can move the surface by numbers that are no controls. Of `TOLD` what it does is a
control, or follows from the first.
"""

from collections.abc import Callable

import bpy

from . import stacks
from .base import bulge, link, tube
from .bones import NewBone, add_bones, limit
from .controls import add_key
from .skinning import two_armatures

MUSCLES, MUSCLE = "muscle_rig", "muscle"


def bone() -> bpy.types.PoseBone:
    """The bone of the second armature."""
    return bpy.data.objects[MUSCLES].pose.bones[MUSCLE]


def quaternion() -> None:
    two_armatures()
    bone().rotation_mode = "QUATERNION"


def axis_angle() -> None:
    two_armatures()
    bone().rotation_mode = "AXIS_ANGLE"


def free_location() -> None:
    two_armatures()
    bone().lock_location[2] = False


def free_scale() -> None:
    two_armatures()
    bone().lock_scale = (False, False, False)


def free_root() -> None:
    """The bone that deforms follows one that does not, and is free."""
    two_armatures()
    armature_object = bpy.data.objects[MUSCLES]
    add_bones(armature_object, NewBone("root", (0.1, 0.0, -0.1), (0.1, 0.0, 0.0), is_deforming=False))
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    armature_object.data.edit_bones[MUSCLE].parent = armature_object.data.edit_bones["root"]
    bpy.ops.object.mode_set(mode="OBJECT")
    armature_object.pose.bones["root"].lock_rotation = (False, False, False)
    armature_object.pose.bones["root"].rotation_mode = "QUATERNION"


def hook_on_a_bone() -> None:
    stacks.hook()
    handle = bpy.data.objects["handle"]
    matrix = handle.matrix_world.copy()
    handle.parent, handle.parent_type, handle.parent_bone = _free_bones(), "BONE", MUSCLE
    bpy.context.view_layer.update()
    handle.matrix_world = matrix


def hook_that_copies_a_bone() -> None:
    stacks.hook()
    handle = bpy.data.objects["handle"]
    handle.parent = None
    copy = handle.constraints.new("COPY_TRANSFORMS")
    copy.target, copy.subtarget = _free_bones(), MUSCLE


def lattice_on_a_bone() -> None:
    stacks.lattice()
    lattice_object = bpy.data.objects["lattice"]
    lattice_object.vertex_groups.new(name=MUSCLE).add(range(54), 1.0, "REPLACE")
    lattice_object.modifiers.new("Muscles", "ARMATURE").object = _free_bones()


def driver_of_a_bone() -> None:
    """The driver of a shape key reads how a bone is turned."""
    _follow_transform("ROT_X")


def driver_of_a_channel() -> None:
    """The driver of a shape key reads a number of a quaternion."""
    mesh_object, _ = tube()
    armature_object = _free_bones()
    driver = add_key(mesh_object, "flexed", bulge).driver_add("value").driver
    variable = driver.variables.new()
    variable.name, variable.targets[0].id = "x", armature_object
    variable.targets[0].data_path = f'pose.bones["{MUSCLE}"].rotation_quaternion[1]'
    driver.expression = "x"


def limited_location() -> None:
    two_armatures()
    limit(bone(), "LIMIT_LOCATION", {2: (-0.02, 0.02)})


def copied_from_the_first() -> None:
    """Free bones that a constraint takes to a bone of the first armature which deforms nothing."""
    two_armatures()
    armature_object = bpy.data.objects["elbow_rig"]
    add_bones(armature_object, NewBone("handle", (0.1, 0.0, 0.0), (0.1, 0.0, 0.1), is_deforming=False))
    limit(armature_object.pose.bones["handle"], "LIMIT_ROTATION", {0: (-20.0, 20.0)})
    _release(bone())
    copy = bone().constraints.new("COPY_TRANSFORMS")
    copy.target, copy.subtarget = armature_object, "handle"


REFUSED: tuple[Callable[[], None], ...] = (
    quaternion, axis_angle, free_location, free_scale, free_root, hook_on_a_bone, hook_that_copies_a_bone,
    lattice_on_a_bone, driver_of_a_bone, driver_of_a_channel,
)  # fmt: skip
TOLD: tuple[Callable[[], None], ...] = (two_armatures, limited_location, copied_from_the_first)


def _free_bones() -> bpy.types.Object:
    """A second armature as Blender makes it: quaternions, nothing locked."""
    found = link(bpy.data.objects.new(MUSCLES, bpy.data.armatures.new(MUSCLES)))
    add_bones(found, NewBone(MUSCLE, (0.1, 0.0, 0.0), (0.1, 0.0, 0.1)))
    _release(found.pose.bones[MUSCLE])
    return found


def _release(free: bpy.types.PoseBone) -> None:
    free.rotation_mode = "QUATERNION"
    free.lock_location = free.lock_rotation = free.lock_scale = (False, False, False)


def _follow_transform(channel: str) -> None:
    mesh_object, _ = tube()
    driver = add_key(mesh_object, "flexed", bulge).driver_add("value").driver
    variable = driver.variables.new()
    variable.name, variable.type = "turn", "TRANSFORMS"
    target = variable.targets[0]
    target.id, target.bone_target, target.transform_type = _free_bones(), MUSCLE, channel
    target.transform_space = "LOCAL_SPACE"
    driver.expression = "turn"
