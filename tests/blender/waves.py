# SPDX-License-Identifier: GPL-3.0-or-later
"""An action that waves one bone."""

import bpy

ACTION = "wave"


def wave(armature_object: bpy.types.Object, bone_name: str) -> bpy.types.Action:
    """Key a rotation of a bone in a new action, which the armature object then no longer has."""
    bone = armature_object.pose.bones[bone_name]
    bone.rotation_mode = "XYZ"
    animation = armature_object.animation_data_create()
    animation.action = bpy.data.actions.new(f"{ACTION} {bone_name}")
    animation.action.use_fake_user = True
    for frame, angle in ((1, -0.4), (20, 0.6)):
        bone.rotation_euler = (angle, 0.3 * angle, 0.0)
        bone.keyframe_insert("rotation_euler", frame=frame)
    action, animation.action = animation.action, None
    bone.rotation_euler = (0, 0, 0)
    return action
