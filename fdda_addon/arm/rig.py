# SPDX-License-Identifier: GPL-3.0-or-later
"""The arm as Blender objects: mesh, armature, range of motion and three deformers."""

import math

import bpy
import numpy as np

from ..scene.arrays import COORDINATE_ELEMENT, MATERIAL_INDEX_ELEMENT, write
from .action import assign_drive_action
from .joints import ARM_OBJECT, BICEPS_KEY, ELBOW_FLEXION, JOINT_NAMES, JOINTS, LOCKED, RIG_OBJECT, ROTATION_MODE
from .surface import Surface, sculpt_arm

# Corrective Smooth by density: (iterations, factor). On finer quads each iteration reaches less far.
SMOOTHING = {1: (10, 0.5), 2: (20, 0.8), 3: (30, 1.0)}
# Linear RGBA and roughness.
_SKIN = ((0.72, 0.42, 0.31, 1.0), 0.50)
_NAIL = ((0.82, 0.50, 0.40, 1.0), 0.35)


def build_arm(density: int = 1) -> tuple[bpy.types.Object, bpy.types.Object]:
    """Add the arm and its rig to the current scene; return mesh object and armature object.

    Layers: hard skinning through an Armature modifier, the biceps shape key raised by a driver, Corrective Smooth. The
    action `arm_drive` is assigned and the scene's range set to it. ValueError for a density other than 1, 2 or 3.
    """
    surface = sculpt_arm(density)
    rig = _armature_object()
    _set_range_of_motion(rig)
    arm = _mesh_object(surface)
    arm.parent = rig
    _add_skinning(arm, rig, surface.joints)
    _add_biceps(arm, rig, surface)
    _add_smoothing(arm, density)
    assign_drive_action(rig)
    bpy.context.view_layer.update()
    return arm, rig


def _armature_object() -> bpy.types.Object:
    armature = bpy.data.armatures.new(RIG_OBJECT)
    armature.display_type = "STICK"
    rig = bpy.data.objects.new(RIG_OBJECT, armature)
    rig.show_in_front = True
    bpy.context.scene.collection.objects.link(rig)
    # Bones can only be added in edit mode, which works on the active object.
    layer = bpy.context.view_layer
    before = layer.objects.active
    if before is not None and before.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        for joint in JOINTS:
            bone = armature.edit_bones.new(joint.name)
            bone.head, bone.tail = joint.head, joint.tail
            bone.align_roll(joint.bend)
            if joint.parent is not None:
                parent = armature.edit_bones[joint.parent]
                bone.parent = parent
                bone.use_connect = (parent.tail - bone.head).length < 1e-6
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")
        layer.objects.active = before if before is not None else rig
    return rig


def _set_range_of_motion(rig: bpy.types.Object):
    """Set the range of motion as IK limits and locks, which do not clamp posing, so an action may exceed it."""
    for joint in JOINTS:
        bone = rig.pose.bones[joint.name]
        bone.rotation_mode = ROTATION_MODE
        bone.lock_location = (True, True, True)
        bone.lock_scale = (True, True, True)
        bone.lock_rotation = tuple(limits == LOCKED for limits in joint.limits)
        for axis, (low, high) in zip("xyz", joint.limits, strict=True):
            setattr(bone, f"lock_ik_{axis}", (low, high) == LOCKED)
            setattr(bone, f"use_ik_limit_{axis}", True)
            setattr(bone, f"ik_min_{axis}", math.radians(low))
            setattr(bone, f"ik_max_{axis}", math.radians(high))


def _mesh_object(surface: Surface) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(ARM_OBJECT)
    mesh.from_pydata(surface.points.tolist(), [], surface.faces.tolist())
    mesh.shade_smooth()
    for name, look in (("arm_skin", _SKIN), ("arm_nail", _NAIL)):
        mesh.materials.append(_material(name, *look))
    write(mesh.polygons, MATERIAL_INDEX_ELEMENT, surface.nails.astype(np.int32))
    mesh.update()
    arm = bpy.data.objects.new(ARM_OBJECT, mesh)
    bpy.context.scene.collection.objects.link(arm)
    return arm


def _material(name: str, color: tuple[float, float, float, float], roughness: float) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    material.diffuse_color = color
    material.roughness = roughness
    if material.node_tree is None:
        material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = color
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Subsurface Weight"].default_value = 0.15
    shader.inputs["Subsurface Scale"].default_value = 0.01
    return material


def _add_skinning(arm: bpy.types.Object, rig: bpy.types.Object, joints: np.ndarray):
    for index, name in enumerate(JOINT_NAMES):
        group = arm.vertex_groups.new(name=name)
        group.add(np.flatnonzero(joints == index).tolist(), 1.0, "REPLACE")
    modifier = arm.modifiers.new("Armature", "ARMATURE")
    modifier.object = rig
    modifier.use_vertex_groups = True
    modifier.use_bone_envelopes = False
    modifier.use_deform_preserve_volume = False


def _add_biceps(arm: bpy.types.Object, rig: bpy.types.Object, surface: Surface):
    basis = arm.shape_key_add(name="Basis", from_mix=False)
    key = arm.shape_key_add(name=BICEPS_KEY, from_mix=False)
    key.relative_key = basis
    write(key.data, COORDINATE_ELEMENT, (surface.points + surface.biceps).astype(np.float32))
    driver = key.driver_add("value").driver
    driver.type = "SCRIPTED"
    variable = driver.variables.new()
    variable.name = "elbow"
    variable.type = "TRANSFORMS"
    target = variable.targets[0]
    target.id = rig
    target.bone_target = "elbow"
    target.transform_type = "ROT_X"
    target.transform_space = "LOCAL_SPACE"
    # A simple expression: Blender works it out itself, also where Python scripts are disabled.
    driver.expression = f"clamp(elbow / {math.radians(ELBOW_FLEXION):.6f}, 0, 1)"


def _add_smoothing(arm: bpy.types.Object, density: int):
    modifier = arm.modifiers.new("CorrectiveSmooth", "CORRECTIVE_SMOOTH")
    modifier.rest_source = "ORCO"
    modifier.smooth_type = "SIMPLE"
    modifier.iterations, modifier.factor = SMOOTHING[density]
