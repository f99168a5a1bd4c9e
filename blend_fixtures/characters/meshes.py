# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters of several meshes, of many bones, without weights: each function builds one in the current scene."""

from collections.abc import Callable

import bpy
import numpy as np

from blend_fixtures.elbow import END, START

from .base import cage, link, skin, tube
from .bones import NewBone, add_bones, limit, mush

FINGERS, SEGMENTS = 25, 20
"""Of the creature with 500 bones."""


def body_and_sleeve() -> None:
    """Two meshes on one armature: the tube with delta mush, and a mesh object `sleeve` that is pulled towards it."""
    mesh_object, armature_object = tube()
    mush(mesh_object)
    sleeve = cage("sleeve", 1.15)
    skin(sleeve, armature_object)
    mush(sleeve, 10)
    modifier = sleeve.modifiers.new("Shrinkwrap", "SHRINKWRAP")
    modifier.target, modifier.offset = mesh_object, 0.004


def through_a_lattice() -> None:
    """A tube without weights inside a lattice, whose points follow the bones."""
    mesh_object, armature_object = tube()
    mesh_object.modifiers.clear()
    mesh_object.vertex_groups.clear()
    mesh_object.parent = None
    data = bpy.data.lattices.new("lattice")
    data.points_u, data.points_v, data.points_w = 9, 3, 3
    # Else Blender smooths between the points, and the mesh turns less than they do.
    for axis in "uvw":
        setattr(data, f"interpolation_type_{axis}", "KEY_LINEAR")
    lattice_object = link(bpy.data.objects.new("lattice", data))
    lattice_object.location, lattice_object.scale = ((START + END) / 2, 0.0, 0.0), (0.56, 0.15, 0.15)
    along = np.array([point.co_deform.x for point in data.points])
    lower = np.clip(along / 0.4 + 0.5, 0.0, 1.0)
    for name, weights in (("upper", 1.0 - lower), ("lower", lower)):
        group = lattice_object.vertex_groups.new(name=name)
        for point in np.flatnonzero(weights):
            group.add([int(point)], float(weights[point]), "REPLACE")
    lattice_object.modifiers.new("Armature", "ARMATURE").object = armature_object
    mesh_object.modifiers.new("Lattice", "LATTICE").object = lattice_object


def five_hundred_bones() -> None:
    """A creature of 25 strips beside each other, each a chain of 20 bones and 84 vertices; delta mush."""
    armature_object = link(bpy.data.objects.new("creature_rig", bpy.data.armatures.new("creature_rig")))
    length = (END - START) / SEGMENTS
    add_bones(
        armature_object,
        *(
            NewBone(
                _bone(finger, number),
                (number * length, finger * 0.05, 0.0),
                ((number + 1) * length, finger * 0.05, 0.0),
                _bone(finger, number - 1) if number else "",
                is_connected=number > 0,
            )
            for finger in range(FINGERS)
            for number in range(SEGMENTS)
        ),
    )
    for bone in armature_object.pose.bones:
        limit(bone, "LIMIT_ROTATION", {axis: (-12.0, 12.0) for axis in (0, 2)})
    mesh_object = link(bpy.data.objects.new("creature", _strips(length)))
    mesh_object.parent = armature_object
    for finger in range(FINGERS):
        for number in range(SEGMENTS):
            group = mesh_object.vertex_groups.new(name=_bone(finger, number))
            first = (finger * (SEGMENTS + 1) + number) * 4
            group.add(range(first, first + 4), 0.5 if number else 1.0, "REPLACE")
            group.add(range(first + 4, first + 8), 0.5 if number + 1 < SEGMENTS else 1.0, "REPLACE")
    mesh_object.modifiers.new("Armature", "ARMATURE").object = armature_object
    mush(mesh_object, 3)


MESHES: tuple[Callable[[], None], ...] = (body_and_sleeve, through_a_lattice, five_hundred_bones)


def _bone(finger: int, number: int) -> str:
    return f"finger.{finger:02}.{number:02}"


def _strips(length: float) -> bpy.types.Mesh:
    """Square tubes, a ring of four vertices at each end of a bone."""
    ring = np.array([(0.0, y, z) for y, z in ((-0.01, -0.01), (0.01, -0.01), (0.01, 0.01), (-0.01, 0.01))])
    points = [
        ring + np.array((number * length, finger * 0.05, 0.0))
        for finger in range(FINGERS)
        for number in range(SEGMENTS + 1)
    ]
    faces = []
    for finger in range(FINGERS):
        for number in range(SEGMENTS):
            first = (finger * (SEGMENTS + 1) + number) * 4
            faces += [(first + k, first + (k + 1) % 4, first + (k + 1) % 4 + 4, first + k + 4) for k in range(4)]
    mesh = bpy.data.meshes.new("creature")
    mesh.from_pydata(np.concatenate(points).tolist(), [], faces)
    mesh.update()
    return mesh
