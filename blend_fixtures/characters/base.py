# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the parts of the characters in this folder: a tube with two bones, cages around it, driven shape keys.

All functions build in the current scene. The mesh object of a character is `elbow`, its armature object `elbow_rig`.
"""

from collections.abc import Callable

import bpy
import numpy as np

from blend_fixtures.elbow import JOINT, build_elbow, elbow_surface, lower_weights


def tube() -> tuple[bpy.types.Object, bpy.types.Object]:
    """Build an elbow with only an Armature modifier; return its mesh object and its armature object."""
    mesh_object, armature_object = build_elbow()
    mesh_object.modifiers.remove(mesh_object.modifiers["CorrectiveSmooth"])
    return mesh_object, armature_object


def cage(name: str, thickness: float) -> bpy.types.Object:
    """Build a mesh object around the tube that is `thickness` times as thick and has no modifiers."""
    points, faces = elbow_surface()
    points[:, 0] = JOINT + (points[:, 0] - JOINT) * 1.05
    points[:, 1:] *= thickness
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points.tolist(), [], faces.tolist())
    mesh.update()
    return link(bpy.data.objects.new(name, mesh))


def link(scene_object: bpy.types.Object) -> bpy.types.Object:
    """Link an object to the scene and return it."""
    bpy.context.scene.collection.objects.link(scene_object)
    return scene_object


def skin(mesh_object: bpy.types.Object, armature_object: bpy.types.Object) -> None:
    """Add the weights of the tube and an Armature modifier to a mesh object."""
    weights = lower_weights(np.array([vertex.co for vertex in mesh_object.data.vertices]))
    for name, values in (("upper", 1.0 - weights), ("lower", weights)):
        group = mesh_object.vertex_groups.new(name=name)
        for index in np.flatnonzero(values > 0.0):
            group.add([int(index)], float(values[index]), "REPLACE")
    mesh_object.modifiers.new("Armature", "ARMATURE").object = armature_object


def add_driven_key(
    owner: bpy.types.Object, armature_object: bpy.types.Object, move: Callable[[np.ndarray], np.ndarray]
) -> bpy.types.ShapeKey:
    """Add a shape key whose value is the angle of the lower bone: 0 at rest, 1 at one radian.

    Args:
        owner: a mesh, lattice or curve object.
        armature_object: armature object of the tube.
        move: function from the points of the basis to the points of the key, (N, 3) each, in the owner's space.
    """
    if owner.data.shape_keys is None:
        owner.shape_key_add(name="Basis", from_mix=False)
    key = owner.shape_key_add(name="bent", from_mix=False)
    points = np.array([point.co for point in key.data])
    for point, co in zip(key.data, move(points), strict=True):
        point.co = co
    drive(key, "value", armature_object, "bend")
    return key


def drive(owner: bpy.types.bpy_struct, path: str, armature_object: bpy.types.Object, expression: str) -> None:
    """Drive a property with an expression of `bend`, the angle of the lower bone in radians."""
    driver = owner.driver_add(path).driver
    variable = driver.variables.new()
    variable.name = "bend"
    variable.targets[0].id = armature_object
    variable.targets[0].data_path = 'pose.bones["lower"].rotation_euler[0]'
    driver.expression = expression


def bulge(points: np.ndarray) -> np.ndarray:
    """Move the points near the joint away from the axis of the tube by up to half their distance."""
    joint_proximity = np.exp(-(((points[:, :1] - JOINT) / 0.08) ** 2))
    return np.hstack([points[:, :1], points[:, 1:] * (1.0 + 0.5 * joint_proximity)])
