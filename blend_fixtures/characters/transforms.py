# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters whose objects are moved, turned, scaled and parented, or built in other units: one function each.

Each builds an elbow with delta mush in the current scene, named as in `base`.
"""

from collections.abc import Callable
from math import radians

import bpy
from mathutils import Euler, Matrix, Vector

from blend_fixtures.elbow import build_elbow

from .base import link

CENTIMETRES, MILLIMETRES, KILOMETRES = 100.0, 1000.0, 0.001
"""Blender units in a meter where a unit is a centimeter, a millimeter, a kilometer."""


def moved() -> None:
    """Mesh and armature each moved, turned and scaled by other factors along each axis; neither has a parent."""
    mesh_object, armature_object = build_elbow()
    mesh_object.parent = None
    _place(mesh_object, (0.3, -0.2, 0.1), (20, 40, -30), (1.3, 0.8, 1.1))
    _place(armature_object, (-0.5, 0.1, 0.9), (-10, 15, 70), (0.9, 1.2, 0.7))


def parented_to_armature() -> None:
    """The mesh follows a turned and scaled armature from a place of its own."""
    mesh_object, armature_object = build_elbow()
    _place(armature_object, (1.5, -2.0, 0.4), (35, -20, 110), (1.4, 0.9, 1.1))
    mesh_object.matrix_parent_inverse = armature_object.matrix_world.inverted()
    _place(mesh_object, (1.4, -2.1, 0.3), (30, -15, 100), (1.2, 1.0, 0.9))


def parented_to_empty() -> None:
    """The mesh follows the armature and the armature an empty, which an action moves, turns and scales."""
    _, armature_object = build_elbow()
    empty = link(bpy.data.objects.new("carrier", None))
    armature_object.parent = empty
    _place(armature_object, (0.1, 0.2, 0.0), (0, 0, 45), (1.1, 1.1, 0.9))
    for frame, location, degrees, scale in (
        (1, (2.0, -1.0, 0.5), (0, 10, 0), (1.0, 1.0, 1.0)),
        (15, (3.0, 4.0, 0.0), (25, -40, 120), (1.3, 1.1, 0.8)),
        (30, (-6.0, 8.0, 2.0), (80, 0, 300), (0.5, 0.5, 0.5)),
    ):
        _place(empty, location, degrees, scale)
        for path in ("location", "rotation_euler", "scale"):
            empty.keyframe_insert(path, frame=frame)


def parented_to_bone() -> None:
    """The mesh is parented to the upper bone besides: with its Armature modifier it moves twice as far."""
    mesh_object, armature_object = build_elbow()
    mesh_object.parent_type, mesh_object.parent_bone = "BONE", "upper"
    bpy.context.view_layer.update()
    # Where it was before, in the rest pose.
    to_bone = armature_object.pose.bones["upper"].matrix @ Matrix.Translation((0.0, 0.25, 0.0))
    mesh_object.matrix_parent_inverse = to_bone.inverted()


def in_centimetres() -> None:
    """A scene whose unit is a centimeter: positions in tens, unit scale 0.01."""
    _in_unit(CENTIMETRES)


def in_millimetres() -> None:
    """A scene whose unit is a millimeter: positions in hundreds, unit scale 0.001."""
    _in_unit(MILLIMETRES)


def in_kilometres() -> None:
    """A scene whose unit is a kilometer: positions in ten-thousandths, unit scale 1000."""
    _in_unit(KILOMETRES)


def far_from_its_origin() -> None:
    """Mesh and bones 100 meters from the origins of their objects, which stand as far on the other side."""
    away = Vector((60.0, -80.0, 0.0))
    mesh_object, armature_object = build_elbow()
    for scene_object in (mesh_object, armature_object):
        scene_object.data.transform(Matrix.Translation(away))
    _place(armature_object, tuple(-away), (0, 0, 0), (1.0, 1.0, 1.0))


def scaled_armature() -> None:
    """An armature as FBX brings it, in centimeters with an object scale of 0.01; the mesh is in meters, unparented."""
    mesh_object, armature_object = build_elbow()
    mesh_object.parent = None
    _enlarge(armature_object)
    _place(armature_object, (0.0, 0.0, 0.0), (90, 0, 0), (1 / CENTIMETRES,) * 3)
    mesh_object.matrix_world = Matrix.Rotation(radians(90), 4, "X")


def scaled_character() -> None:
    """Mesh and armature as FBX brings them: both in centimeters, turned upright and scaled by 0.01."""
    mesh_object, armature_object = build_elbow()
    for scene_object in (mesh_object, armature_object):
        _enlarge(scene_object)
    _place(armature_object, (0.0, 0.0, 0.0), (90, 0, 0), (1 / CENTIMETRES,) * 3)


def far_away() -> None:
    """A character in meters, some hundreds of meters from the world's origin."""
    _, armature_object = build_elbow()
    _place(armature_object, (300.0, -200.0, 50.0), (10, 20, 30), (1.0, 1.0, 1.0))


TRANSFORMS: tuple[Callable[[], None], ...] = (
    moved, parented_to_armature, parented_to_empty, parented_to_bone, in_centimetres, scaled_armature, scaled_character,
    far_away, in_millimetres, in_kilometres, far_from_its_origin,
)  # fmt: skip


def _in_unit(units_in_a_metre: float) -> None:
    for scene_object in build_elbow():
        _enlarge(scene_object, units_in_a_metre)
    bpy.context.scene.unit_settings.scale_length = 1.0 / units_in_a_metre


def _place(
    scene_object: bpy.types.Object,
    location: tuple[float, float, float],
    degrees: tuple[float, float, float],
    scale: tuple[float, float, float],
) -> None:
    """Set the transform of an object, in the space of its parent."""
    scene_object.location, scene_object.scale = location, scale
    scene_object.rotation_euler = Euler([radians(angle) for angle in degrees])
    bpy.context.view_layer.update()


def _enlarge(scene_object: bpy.types.Object, units_in_a_metre: float = CENTIMETRES) -> None:
    """Build the data of an object in another unit."""
    scene_object.data.transform(Matrix.Scale(units_in_a_metre, 4))
