# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the arm as Blender objects: mesh, armature, range of motion and three deformers."""

import math
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ..scene.arrays import COORDINATE_ELEMENT, MATERIAL_INDEX_ELEMENT, write
from .action import assign_drive_action
from .joints import ARM_OBJECT, BICEPS_KEY, ELBOW_FLEXION, JOINT_NAMES, JOINTS, LOCKED_RANGE, RIG_OBJECT, ROTATION_MODE

# Iterations and factor of Corrective Smooth, by density. On finer quads, each iteration smooths a smaller distance.
SMOOTHING_SETTINGS = {1: (10, 0.5), 2: (20, 0.8), 3: (30, 1.0)}
# Color (linear RGBA) and roughness of a material.
_SKIN_MATERIAL = ((0.72, 0.42, 0.31, 1.0), 0.50)
_NAIL_MATERIAL = ((0.82, 0.50, 0.40, 1.0), 0.35)
DENSITIES = (1, 2, 3)
"""Densities of the mesh, with about 1,450, 10,000 and 50,000 vertices."""


@dataclass(frozen=True)
class Surface:
    """The surface of the arm, one closed surface of quads.

    Attributes:
        points: (v, 3) float32, rest positions, meters, arm space (see `joints`).
        contracted: (v, 3) float32, the same with a contracted biceps.
        faces: (f, 4) int32, oriented outwards.
        joints: (v,) int32, index into `joints.JOINTS` of the bone of each vertex.
        nails: (f,) bool, whether a face is part of a nail.
    """

    points: np.ndarray
    contracted: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    nails: np.ndarray


def read_surface(density: int) -> Surface:
    """Read the surface of a density in `DENSITIES`."""
    if density not in DENSITIES:
        raise ValueError(f"The arm has densities 1, 2 and 3; {density!r} is none of them.")
    with np.load(Path(__file__).with_name("surface.npz"), allow_pickle=False) as arrays:
        names = ("points", "face_steps", "joints", "nails", "biceps_vertices", "biceps_points")
        points, face_steps, joints, nails, biceps_vertices, biceps_points = (arrays[f"{n}_{density}"] for n in names)
    contracted = points.copy()
    contracted[biceps_vertices] = biceps_points
    # The file has the differences between faces, which compress well.
    faces = face_steps.cumsum(axis=0, dtype=face_steps.dtype).astype(np.int32)
    return Surface(points, contracted, faces, joints.astype(np.int32), nails)


def build_arm(density: int = 1) -> tuple[bpy.types.Object, bpy.types.Object]:
    """Add the arm and its rig to the current scene; return mesh object and armature object.

    The arm has three deformers: an Armature modifier with hard skinning, a biceps shape key with a driver, and
    Corrective Smooth. The action `arm_drive` is assigned, and the scene gets its frame range.
    """
    surface = read_surface(density)
    armature_object = _create_armature_object()
    # Set the range of motion as IK limits and locks, which do not clamp posing, so an action may exceed it.
    for joint in JOINTS:
        bone = armature_object.pose.bones[joint.name]
        bone.rotation_mode = ROTATION_MODE
        bone.lock_location = (True, True, True)
        bone.lock_scale = (True, True, True)
        bone.lock_rotation = tuple(limits == LOCKED_RANGE for limits in joint.limits)
        for axis, (low, high) in zip("xyz", joint.limits, strict=True):
            setattr(bone, f"lock_ik_{axis}", (low, high) == LOCKED_RANGE)
            setattr(bone, f"use_ik_limit_{axis}", True)
            setattr(bone, f"ik_min_{axis}", math.radians(low))
            setattr(bone, f"ik_max_{axis}", math.radians(high))
    mesh_object = _create_mesh_object(surface)
    mesh_object.parent = armature_object
    for index, name in enumerate(JOINT_NAMES):
        group = mesh_object.vertex_groups.new(name=name)
        group.add(np.flatnonzero(surface.joints == index).tolist(), 1.0, "REPLACE")
    modifier = mesh_object.modifiers.new("Armature", "ARMATURE")
    modifier.object = armature_object
    modifier.use_vertex_groups = True
    modifier.use_bone_envelopes = False
    modifier.use_deform_preserve_volume = False
    basis = mesh_object.shape_key_add(name="Basis", from_mix=False)
    key = mesh_object.shape_key_add(name=BICEPS_KEY, from_mix=False)
    key.relative_key = basis
    write(key.data, COORDINATE_ELEMENT, surface.contracted)
    driver = key.driver_add("value").driver
    driver.type = "SCRIPTED"
    variable = driver.variables.new()
    variable.name = "elbow"
    variable.type = "TRANSFORMS"
    target = variable.targets[0]
    target.id = armature_object
    target.bone_target = "elbow"
    target.transform_type = "ROT_X"
    target.transform_space = "LOCAL_SPACE"
    # Blender evaluates such a simple expression itself, even if Python scripts are disabled.
    driver.expression = f"clamp(elbow / {math.radians(ELBOW_FLEXION):.6f}, 0, 1)"
    modifier = mesh_object.modifiers.new("CorrectiveSmooth", "CORRECTIVE_SMOOTH")
    modifier.rest_source = "ORCO"
    modifier.smooth_type = "SIMPLE"
    modifier.iterations, modifier.factor = SMOOTHING_SETTINGS[density]
    assign_drive_action(armature_object)
    bpy.context.view_layer.update()
    return mesh_object, armature_object


def _create_armature_object() -> bpy.types.Object:
    armature = bpy.data.armatures.new(RIG_OBJECT)
    armature.display_type = "STICK"
    armature_object = bpy.data.objects.new(RIG_OBJECT, armature)
    armature_object.show_in_front = True
    bpy.context.scene.collection.objects.link(armature_object)
    # Bones can only be added in edit mode, which works on the active object.
    view_layer = bpy.context.view_layer
    previous_active_object = view_layer.objects.active
    if previous_active_object is not None and previous_active_object.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    view_layer.objects.active = armature_object
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
        view_layer.objects.active = previous_active_object if previous_active_object is not None else armature_object
    return armature_object


def _create_mesh_object(surface: Surface) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(ARM_OBJECT)
    mesh.from_pydata(surface.points.tolist(), [], surface.faces.tolist())
    mesh.shade_smooth()
    for name, color_and_roughness in (("arm_skin", _SKIN_MATERIAL), ("arm_nail", _NAIL_MATERIAL)):
        mesh.materials.append(_create_material(name, *color_and_roughness))
    write(mesh.polygons, MATERIAL_INDEX_ELEMENT, surface.nails.astype(np.int32))
    mesh.update()
    mesh_object = bpy.data.objects.new(ARM_OBJECT, mesh)
    bpy.context.scene.collection.objects.link(mesh_object)
    return mesh_object


def _create_material(name: str, color: tuple[float, float, float, float], roughness: float) -> bpy.types.Material:
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
