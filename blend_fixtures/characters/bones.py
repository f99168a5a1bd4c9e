# SPDX-License-Identifier: GPL-3.0-or-later
"""Bones for the characters of this folder: added to an armature, limited, and a limb with a chain of them."""

from dataclasses import dataclass
from math import radians

import bpy
import numpy as np

from blend_fixtures.elbow import END, START, elbow_surface
from fdda_addon.poses.motion_range import set_constraint_limit

from .base import link

Point = tuple[float, float, float]
KINDS = {"LIMIT_ROTATION": "lock_rotation", "LIMIT_LOCATION": "lock_location", "LIMIT_SCALE": "lock_scale"}


@dataclass(frozen=True)
class NewBone:
    """A bone to be added; ends in armature space, meters."""

    name: str
    head: Point
    tail: Point
    parent: str = ""
    is_deforming: bool = True
    is_connected: bool = False


def add_bones(armature_object: bpy.types.Object, *wanted: NewBone) -> None:
    """Add bones, parents before their children. They rotate by Euler angles, as far as a limit lets them."""
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        bones = armature_object.data.edit_bones
        for new in wanted:
            bone = bones.new(new.name)
            bone.head, bone.tail, bone.use_deform = new.head, new.tail, new.is_deforming
            bone.align_roll((0.0, -1.0, 0.0))
            bone.parent, bone.use_connect = bones.get(new.parent), new.is_connected
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")
    for new in wanted:
        bone = armature_object.pose.bones[new.name]
        bone.rotation_mode = "XYZ"
        bone.lock_location = bone.lock_rotation = bone.lock_scale = (True, True, True)


def limit(bone: bpy.types.PoseBone, kind: str, ranges: dict[int, tuple[float, float]]) -> None:
    """Let a bone move on some axes, in local space, and on no others.

    Args:
        bone: the pose bone.
        kind: of the constraint, one of `KINDS`.
        ranges: by axis; degrees, meters or factors.
    """
    constraint = bone.constraints.new(kind)
    constraint.owner_space = "LOCAL"
    for axis, bounds in ranges.items():
        low, high = map(radians, bounds) if kind == "LIMIT_ROTATION" else bounds
        set_constraint_limit(constraint, axis, low, high)
    setattr(bone, KINDS[kind], [axis not in ranges for axis in range(3)])


def free(bone: bpy.types.PoseBone) -> None:
    """Remove the constraints of a bone."""
    for constraint in list(bone.constraints):
        bone.constraints.remove(constraint)


def in_collection(armature_object: bpy.types.Object, name: str, *bones: str) -> None:
    """Put bones into a bone collection of their own."""
    collection = armature_object.data.collections.new(name)
    for bone in bones:
        collection.assign(armature_object.data.bones[bone])


def limb(count: int, degrees: float = 30.0, twist: float = 0.0) -> tuple[bpy.types.Object, bpy.types.Object]:
    """A tube along a chain of bones, `bone.0` and so on: mesh object `limb`, armature object `limb_rig`, no weights.

    Args:
        count: number of bones.
        degrees: how far each bends to all sides.
        twist: degrees by which each turns about its own axis.
    """
    armature_object = link(bpy.data.objects.new("limb_rig", bpy.data.armatures.new("limb_rig")))
    ends = np.linspace(START, END, count + 1).tolist()
    add_bones(
        armature_object,
        *(
            NewBone(f"bone.{n}", (ends[n], 0.0, 0.0), (ends[n + 1], 0.0, 0.0), f"bone.{n - 1}", is_connected=n > 0)
            for n in range(count)
        ),
    )
    for bone in armature_object.pose.bones:
        ranges = {axis: (-most, most) for axis, most in enumerate((degrees, twist, degrees)) if most}
        limit(bone, "LIMIT_ROTATION", ranges)
    points, faces = elbow_surface()
    mesh = bpy.data.meshes.new("limb")
    mesh.from_pydata(points.tolist(), [], faces.tolist())
    mesh.update()
    mesh_object = link(bpy.data.objects.new("limb", mesh))
    mesh_object.parent = armature_object
    mesh_object.modifiers.new("Armature", "ARMATURE").object = armature_object
    return mesh_object, armature_object


def add_smooth_weights(
    mesh_object: bpy.types.Object, armature_object: bpy.types.Object, most: int, width: float
) -> None:
    """Weights that fall off with the distance from the middle of each bone.

    Args:
        mesh_object, armature_object: of a `limb`.
        most: bones a vertex.
        width: meters over which weights fall off.
    """
    along = np.array([vertex.co.x for vertex in mesh_object.data.vertices])
    bones = [bone for bone in armature_object.data.bones if bone.use_deform]
    middles = np.array([(bone.head_local.x + bone.tail_local.x) / 2 for bone in bones])
    weights = np.exp(-(((along[:, None] - middles) / width) ** 2))
    weights[weights < np.sort(weights, axis=1)[:, -most][:, None]] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    for bone, own in zip(bones, weights.T, strict=True):
        group = mesh_object.vertex_groups.new(name=bone.name)
        for vertex in np.flatnonzero(own):
            group.add([int(vertex)], float(own[vertex]), "REPLACE")


def mush(mesh_object: bpy.types.Object, iterations: int = 6) -> None:
    """Delta mush at the end of the modifiers: what plain skinning does not do."""
    modifier = mesh_object.modifiers.new("Mush", "CORRECTIVE_SMOOTH")
    modifier.rest_source, modifier.factor, modifier.iterations = "ORCO", 0.6, iterations
