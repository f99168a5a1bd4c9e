# SPDX-License-Identifier: GPL-3.0-or-later
"""A symmetric figure with two arms. Actions animate its bones, a custom property and a shape key."""

import math
from collections.abc import Callable

import bpy
import numpy as np
from mathutils import Euler

from fdda_addon.scene.scene_rig import SceneRig

ARM_REACH, ARM_HEIGHT, ARM_RADIUS = 0.8, 0.9, 0.06
WAVE, FRAMES = "wave", 24
SMILE = 'key_blocks["Smile"].value'
_VERTICES_PER_RING, _SEGMENT_COUNT = 8, 24


def build_figure() -> SceneRig:
    """Build the figure in an empty scene.

    Its mesh `body` is a bar along X. Its armature `figure_rig` has the bones spine, arm.L and arm.R.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    armature_object = bpy.data.objects.new("figure_rig", bpy.data.armatures.new("figure_rig"))
    bpy.context.scene.collection.objects.link(armature_object)
    bpy.context.view_layer.objects.active = armature_object
    _build_bones(armature_object)
    points = _rest_positions()
    mesh = bpy.data.meshes.new("body")
    faces = [
        (
            ring * _VERTICES_PER_RING + j,
            ring * _VERTICES_PER_RING + (j + 1) % _VERTICES_PER_RING,
            *(((ring + 1) * _VERTICES_PER_RING + k) for k in (_next_around(j), j)),
        )
        for ring in range(_SEGMENT_COUNT)
        for j in range(_VERTICES_PER_RING)
    ]
    mesh.from_pydata(points.tolist(), [], faces)
    body = bpy.data.objects.new("body", mesh)
    bpy.context.scene.collection.objects.link(body)
    left = np.clip((points[:, 0] - 0.1) / 0.2, 0, 1)
    right = left.reshape(_SEGMENT_COUNT + 1, _VERTICES_PER_RING)[::-1].ravel()
    for name, weights in (("arm.L", left), ("arm.R", right), ("spine", 1 - left - right)):
        group = body.vertex_groups.new(name=name)
        for index in np.flatnonzero(weights > 0):
            group.add([int(index)], float(weights[index]), "REPLACE")
    body.modifiers.new("Armature", "ARMATURE").object = armature_object
    smooth = body.modifiers.new("CorrectiveSmooth", "CORRECTIVE_SMOOTH")
    smooth.rest_source, smooth.factor, smooth.iterations = "ORCO", 0.6, 4
    body.shape_key_add(name="Basis")
    smile = body.shape_key_add(name="Smile")
    for index, point in enumerate(points):
        smile.data[index].co = point * [1, 1, 1 + 0.05 * (abs(point[0]) < 0.1)]
    bpy.context.view_layer.update()
    return SceneRig(body, armature_object)


def _next_around(index: int) -> int:
    return (index + 1) % _VERTICES_PER_RING


def _rest_positions() -> np.ndarray:
    angles = (np.arange(_VERTICES_PER_RING) + 0.5) * 2 * np.pi / _VERTICES_PER_RING
    along = np.linspace(-ARM_REACH, ARM_REACH, _SEGMENT_COUNT + 1)
    return np.array([(x, ARM_RADIUS * np.cos(a), ARM_HEIGHT + ARM_RADIUS * np.sin(a)) for x in along for a in angles])


def _build_bones(armature_object: bpy.types.Object) -> None:
    bpy.ops.object.mode_set(mode="EDIT")
    bones = armature_object.data.edit_bones
    ends = {"spine": ((0, 0, 0), (0, 0, ARM_HEIGHT)), "arm.L": ((0.2, 0, ARM_HEIGHT), (ARM_REACH, 0, ARM_HEIGHT))}
    ends["arm.R"] = tuple((-x, y, z) for x, y, z in ends["arm.L"])
    for name, (head, tail) in ends.items():
        bone = bones.new(name)
        bone.head, bone.tail = head, tail
        bone.align_roll((0, -1, 0))
        bone.parent = bones["spine"] if name != "spine" else None
    bpy.ops.object.mode_set(mode="OBJECT")
    for bone in armature_object.pose.bones:
        bone.rotation_mode = "XYZ" if bone.name == "spine" else "QUATERNION"
        bone["fist"] = 0.0


def key_channel(bone: bpy.types.PoseBone, frame: int, channel: str, value: object) -> None:
    """Set a property of a pose bone, and insert a keyframe."""
    setattr(bone, channel, value)
    bone.keyframe_insert(channel, frame=frame)


def add_wave(rig: SceneRig) -> bpy.types.Action:
    """Add the action `wave`: the spine moves, the left arm swings farther than the right, and its fist closes."""
    animation = rig.armature_object.animation_data_create()
    animation.action = action = bpy.data.actions.new(WAVE)
    bones = rig.armature_object.pose.bones
    for frame in range(1, FRAMES + 1):
        amount = math.sin((frame - 1) / (FRAMES - 1) * math.pi)
        key_channel(bones["spine"], frame, "rotation_euler", (0.1 * amount, 0.4 * amount, 0))
        key_channel(bones["spine"], frame, "location", (0.02 * amount, 0.05 * amount, 0))
        for name, angles in (("arm.L", (0.2 + amount, 0, 0.3 * amount)), ("arm.R", (0.3 * amount, 0.1 * amount, 0))):
            key_channel(bones[name], frame, "rotation_quaternion", Euler(angles).to_quaternion())
        key_channel(bones["arm.R"], frame, "scale", (1, 1 + 0.1 * amount, 1))
        bones["arm.L"]["fist"] = amount
        bones["arm.L"].keyframe_insert('["fist"]', frame=frame)
    bpy.context.view_layer.update()
    return action


def add_smile(rig: SceneRig, action: bpy.types.Action) -> None:
    """Animate the shape key in the same action. This needs a Blender whose actions have slots."""
    keys = rig.mesh_object.data.shape_keys
    animation = keys.animation_data_create()
    action.slots.new(id_type="KEY", name=keys.name)
    animation.action = action
    for frame, value in ((1, 0.0), (FRAMES // 2, 0.8), (FRAMES, 0.0)):
        keys.key_blocks["Smile"].value = value
        keys.keyframe_insert(SMILE, frame=frame)
    keys.key_blocks["Smile"].value = 0
    animation.action = None


def edit_bones(rig: SceneRig, change: Callable[[bpy.types.ArmatureEditBones], None]) -> None:
    """Change the armature's bones in edit mode."""
    bpy.context.view_layer.objects.active = rig.armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    change(rig.armature_object.data.edit_bones)
    bpy.ops.object.mode_set(mode="OBJECT")
