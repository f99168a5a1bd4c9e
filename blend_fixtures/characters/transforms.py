# SPDX-License-Identifier: GPL-3.0-or-later
"""Build characters whose objects are moved, rotated, scaled and parented, or built in other units.

Each function builds an elbow with delta mush in the current scene, with the object names of `base`.
"""

from collections.abc import Callable
from math import radians

import bpy
from mathutils import Euler, Matrix, Vector

from blend_fixtures.elbow import build_elbow

from .base import link

CENTIMETRES, MILLIMETRES, KILOMETRES = 100.0, 1000.0, 0.001
"""Number of Blender units per meter if a unit is a centimeter, a millimeter or a kilometer."""


def moved() -> None:
    """Mesh and armature are moved, rotated and scaled differently along each axis; neither has a parent."""
    mesh_object, armature_object = build_elbow()
    mesh_object.parent = None
    _set_transform(mesh_object, (0.3, -0.2, 0.1), (20, 40, -30), (1.3, 0.8, 1.1))
    _set_transform(armature_object, (-0.5, 0.1, 0.9), (-10, 15, 70), (0.9, 1.2, 0.7))


def parented_to_armature() -> None:
    """The mesh is a child of a rotated and scaled armature, and is moved, rotated and scaled itself."""
    mesh_object, armature_object = build_elbow()
    _set_transform(armature_object, (1.5, -2.0, 0.4), (35, -20, 110), (1.4, 0.9, 1.1))
    mesh_object.matrix_parent_inverse = armature_object.matrix_world.inverted()
    _set_transform(mesh_object, (1.4, -2.1, 0.3), (30, -15, 100), (1.2, 1.0, 0.9))


def parented_to_empty() -> None:
    """The armature is the parent of the mesh and a child of an empty, which an action moves, rotates and scales."""
    _, armature_object = build_elbow()
    empty = link(bpy.data.objects.new("carrier", None))
    armature_object.parent = empty
    _set_transform(armature_object, (0.1, 0.2, 0.0), (0, 0, 45), (1.1, 1.1, 0.9))
    for frame, location, degrees, scale in (
        (1, (2.0, -1.0, 0.5), (0, 10, 0), (1.0, 1.0, 1.0)),
        (15, (3.0, 4.0, 0.0), (25, -40, 120), (1.3, 1.1, 0.8)),
        (30, (-6.0, 8.0, 2.0), (80, 0, 300), (0.5, 0.5, 0.5)),
    ):
        _set_transform(empty, location, degrees, scale)
        for path in ("location", "rotation_euler", "scale"):
            empty.keyframe_insert(path, frame=frame)


def parented_to_bone() -> None:
    """The mesh is a child of the upper bone and has an Armature modifier, so that it moves twice as far."""
    mesh_object, armature_object = build_elbow()
    mesh_object.parent_type, mesh_object.parent_bone = "BONE", "upper"
    bpy.context.view_layer.update()
    # Keep the position of the mesh in the rest pose.
    to_bone = armature_object.pose.bones["upper"].matrix @ Matrix.Translation((0.0, 0.25, 0.0))
    mesh_object.matrix_parent_inverse = to_bone.inverted()


def in_centimetres() -> None:
    """The unit of the scene is a centimeter: coordinates are in the tens, and the unit scale is 0.01."""
    _build_in_unit(CENTIMETRES)


def in_millimetres() -> None:
    """The unit of the scene is a millimeter: coordinates are in the hundreds, and the unit scale is 0.001."""
    _build_in_unit(MILLIMETRES)


def in_kilometres() -> None:
    """The unit of the scene is a kilometer: coordinates are in the ten-thousandths, and the unit scale is 1000."""
    _build_in_unit(KILOMETRES)


def far_from_its_origin() -> None:
    """Mesh and bones lie 100 meters from their objects' origins.

    The objects are moved 100 meters the opposite way, so that the character stays at the world origin.
    """
    offset = Vector((60.0, -80.0, 0.0))
    mesh_object, armature_object = build_elbow()
    for scene_object in (mesh_object, armature_object):
        scene_object.data.transform(Matrix.Translation(offset))
    _set_transform(armature_object, tuple(-offset), (0, 0, 0), (1.0, 1.0, 1.0))


def scaled_armature() -> None:
    """The armature is in centimeters and scaled by 0.01, as FBX imports it; the mesh is in meters without a parent."""
    mesh_object, armature_object = build_elbow()
    mesh_object.parent = None
    _scale_data(armature_object)
    _set_transform(armature_object, (0.0, 0.0, 0.0), (90, 0, 0), (1 / CENTIMETRES,) * 3)
    mesh_object.matrix_world = Matrix.Rotation(radians(90), 4, "X")


def scaled_character() -> None:
    """Mesh and armature are in centimeters, rotated upright and scaled by 0.01, as FBX imports them."""
    mesh_object, armature_object = build_elbow()
    for scene_object in (mesh_object, armature_object):
        _scale_data(scene_object)
    _set_transform(armature_object, (0.0, 0.0, 0.0), (90, 0, 0), (1 / CENTIMETRES,) * 3)


def far_away() -> None:
    """The character is in meters, some hundreds of meters from the world origin."""
    _, armature_object = build_elbow()
    _set_transform(armature_object, (300.0, -200.0, 50.0), (10, 20, 30), (1.0, 1.0, 1.0))


TRANSFORMS: tuple[Callable[[], None], ...] = (
    moved, parented_to_armature, parented_to_empty, parented_to_bone, in_centimetres, scaled_armature, scaled_character,
    far_away, in_millimetres, in_kilometres, far_from_its_origin,
)  # fmt: skip


def _build_in_unit(units_per_metre: float) -> None:
    for scene_object in build_elbow():
        _scale_data(scene_object, units_per_metre)
    bpy.context.scene.unit_settings.scale_length = 1.0 / units_per_metre


def _set_transform(
    scene_object: bpy.types.Object,
    location: tuple[float, float, float],
    degrees: tuple[float, float, float],
    scale: tuple[float, float, float],
) -> None:
    """Set the transform of an object, in the space of its parent."""
    scene_object.location, scene_object.scale = location, scale
    scene_object.rotation_euler = Euler([radians(angle) for angle in degrees])
    bpy.context.view_layer.update()


def _scale_data(scene_object: bpy.types.Object, units_per_metre: float = CENTIMETRES) -> None:
    """Scale the data of an object to another unit."""
    scene_object.data.transform(Matrix.Scale(units_per_metre, 4))
