# SPDX-License-Identifier: GPL-3.0-or-later
"""Build a plain elbow: two bones and a few hundred vertices, small enough for every test."""

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import bpy

ELBOW_OBJECT = "elbow"
RIG_OBJECT = "elbow_rig"
ACTION = "elbow_wave"
FRAMES = 30

# Meters along +X: start of the tube, joint between the two bones, end of the tube; width over which the weights blend.
START, JOINT, END = 0.0, 0.25, 0.50
BLEND_WIDTH = 0.06
_RING_VERTICES, _SEGMENTS = 12, 24

# Degrees about X, Y and Z in local space: the lower bone rotates about X only.
LOWER_RANGE = ((0.0, 120.0), (0.0, 0.0), (0.0, 0.0))
UPPER_RANGE = ((-45.0, 45.0), (-45.0, 45.0), (-45.0, 45.0))


def elbow_surface() -> tuple[np.ndarray, np.ndarray]:
    """Return the points and faces of a closed tube that is thicker above the joint.

    Returns:
        (V, 3) float64 points, meters, and (F, 4) int32 faces, oriented outward.
    """
    along = np.linspace(START, END, _SEGMENTS + 1)
    radii = np.interp(along, (START, 0.10, 0.22, 0.27, 0.34, END), (0.047, 0.052, 0.041, 0.042, 0.046, 0.030))
    angles = np.arange(_RING_VERTICES) * (2 * np.pi / _RING_VERTICES) + np.pi / _RING_VERTICES
    ring_directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = [
        np.column_stack(
            [np.full(_RING_VERTICES, x), ring_directions[:, 0] * r * 1.08, ring_directions[:, 1] * r * 0.94]
        )
        for x, r in zip(along, radii, strict=True)
    ]
    faces = []
    for i in range(_SEGMENTS):
        for j in range(_RING_VERTICES):
            k = (j + 1) % _RING_VERTICES
            a, b = i * _RING_VERTICES, (i + 1) * _RING_VERTICES
            faces.append((a + j, a + k, b + k, b + j))
    faces += _cap(0, outward=False) + _cap(_SEGMENTS * _RING_VERTICES, outward=True)
    # Shrink the end rings a little, because the caps are flat.
    points[0][:, 1:] *= 0.8
    points[-1][:, 1:] *= 0.8
    return np.concatenate(points), np.array(faces, np.int32)


def _cap(first_vertex: int, outward: bool) -> list[tuple[int, int, int, int]]:
    """Close a ring with quads across it; the normal follows the direction of the ring's vertices if `outward`."""
    half = _RING_VERTICES // 2
    quads = []
    for j in range(half - 1):
        last_vertex = first_vertex + _RING_VERTICES - 1
        quad = (first_vertex + j, first_vertex + j + 1, last_vertex - 1 - j, last_vertex - j)
        quads.append(quad if outward else quad[::-1])
    return quads


def lower_weights(points: np.ndarray) -> np.ndarray:
    """Return the (V,) weights of the lower bone, 0 to 1: a smooth step across the joint."""
    t = np.clip((points[:, 0] - JOINT) / BLEND_WIDTH + 0.5, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def skin(
    mesh_object: "bpy.types.Object", armature_object: "bpy.types.Object", points: np.ndarray | None = None
) -> None:
    """Add the weights of the tube and an Armature modifier to a mesh object; `points` are its vertices, unrounded."""
    weights = lower_weights(np.array([v.co for v in mesh_object.data.vertices]) if points is None else points)
    for name, values in (("upper", 1.0 - weights), ("lower", weights)):
        group = mesh_object.vertex_groups.new(name=name)
        for index in np.flatnonzero(values > 0.0):
            group.add([int(index)], float(values[index]), "REPLACE")
    mesh_object.modifiers.new("Armature", "ARMATURE").object = armature_object


def build_elbow() -> "tuple[bpy.types.Object, bpy.types.Object]":
    """Add the elbow to the current scene; return the mesh object `elbow` and the armature object `elbow_rig`.

    The bones are `upper` and `lower`; Limit Rotation constraints in local space set their range of motion. The mesh has
    smooth weights, an Armature modifier and Corrective Smooth. The action `elbow_wave` has 30 frames inside the range.
    """
    import bpy

    points, faces = elbow_surface()
    armature = bpy.data.armatures.new(RIG_OBJECT)
    rig = bpy.data.objects.new(RIG_OBJECT, armature)
    bpy.context.scene.collection.objects.link(rig)
    _add_bones(rig)
    for name, ranges in (("upper", UPPER_RANGE), ("lower", LOWER_RANGE)):
        _limit_rotation(rig.pose.bones[name], ranges)

    mesh = bpy.data.meshes.new(ELBOW_OBJECT)
    mesh.from_pydata(points.tolist(), [], faces.tolist())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))
    mesh.update()
    elbow = bpy.data.objects.new(ELBOW_OBJECT, mesh)
    bpy.context.scene.collection.objects.link(elbow)
    elbow.parent = rig
    skin(elbow, rig, points)
    smooth = elbow.modifiers.new("CorrectiveSmooth", "CORRECTIVE_SMOOTH")
    smooth.rest_source, smooth.factor, smooth.iterations = "ORCO", 0.6, 8
    _add_wave(rig)
    bpy.context.view_layer.update()
    return elbow, rig


def _add_bones(rig: "bpy.types.Object"):
    import bpy

    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    parent = None
    for name, head, tail in (("upper", START, JOINT), ("lower", JOINT, END)):
        bone = rig.data.edit_bones.new(name)
        bone.head, bone.tail = (head, 0.0, 0.0), (tail, 0.0, 0.0)
        # Align local Z to the front, so that a positive rotation about X bends the elbow forward.
        bone.align_roll((0.0, -1.0, 0.0))
        bone.parent, bone.use_connect = parent, parent is not None
        parent = bone
    bpy.ops.object.mode_set(mode="OBJECT")


def _limit_rotation(bone: "bpy.types.PoseBone", ranges):
    bone.rotation_mode = "XYZ"
    bone.lock_location = bone.lock_scale = (True, True, True)
    limit = bone.constraints.new("LIMIT_ROTATION")
    limit.owner_space = "LOCAL"
    for axis, (low, high) in zip("xyz", ranges, strict=True):
        setattr(limit, f"use_limit_{axis}", True)
        setattr(limit, f"min_{axis}", math.radians(low))
        setattr(limit, f"max_{axis}", math.radians(high))


def _add_wave(rig: "bpy.types.Object"):
    import bpy

    rig.animation_data_create().action = bpy.data.actions.new(ACTION)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, FRAMES
    keyed_angles = {1: (0, 0, 0, 0), 10: (100, 20, 0, -15), 20: (30, -25, 10, 30), FRAMES: (0, 0, 0, 0)}
    for frame, (lower_angle, *upper_angles) in keyed_angles.items():
        upper, lower = rig.pose.bones["upper"], rig.pose.bones["lower"]
        upper.rotation_euler = [math.radians(angle) for angle in upper_angles]
        lower.rotation_euler = (math.radians(lower_angle), 0.0, 0.0)
        for bone in (upper, lower):
            bone.keyframe_insert("rotation_euler", frame=frame, group=bone.name)
    scene.frame_set(1)
