# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the parts of the characters in this folder: a tube with two bones, cages around it, driven shape keys.

All functions build in the current scene. The mesh object of a character is `elbow`, its armature object `elbow_rig`.
"""

from collections.abc import Callable

import bpy
import numpy as np

from blend_fixtures.elbow import JOINT, build_elbow, elbow_surface
from fdda_addon.rig.reading import PoseReader
from fdda_addon.runtime.network import Network
from fdda_addon.scene.control_reader import ControlReader
from fdda_addon.scene.scene_rig import SceneRig

BEND = 'pose.bones["lower"].rotation_euler[0]'
"""Path of the angle of the tube's lower bone, radians."""


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


def add_lattice(mesh_object: bpy.types.Object) -> bpy.types.Object:
    """Add a lattice around a tube, which deforms it before the skinning; return the lattice object."""
    data = bpy.data.lattices.new("lattice")
    data.points_u, data.points_v, data.points_w = 6, 3, 3
    lattice_object = link(bpy.data.objects.new("lattice", data))
    lattice_object.location, lattice_object.scale = (0.25, 0.0, 0.0), (0.6, 0.15, 0.15)
    mesh_object.modifiers.new("Lattice", "LATTICE").object = lattice_object
    mesh_object.modifiers.move(1, 0)
    return lattice_object


def add_driven_key(
    owner: bpy.types.Object, armature_object: bpy.types.Object, move: Callable[[np.ndarray], np.ndarray]
) -> bpy.types.ShapeKey:
    """Add a shape key whose value is the angle of the lower bone: 0 at rest, 1 at one radian.

    Args:
        owner: a mesh, lattice or curve object.
        armature_object: armature object of the tube.
        move: function from the points of the basis to the points of the key, (N, 3) each, in the owner's space.
    """
    key = add_key(owner, "bent", move)
    drive(key, "value", armature_object, BEND)
    return key


def add_key(owner: bpy.types.Object, name: str, move: Callable[[np.ndarray], np.ndarray]) -> bpy.types.ShapeKey:
    """Add a shape key.

    Args:
        owner: a mesh, lattice or curve object.
        name: name of the key.
        move: function from the points of the basis to the points of the key, (N, 3) each, in the owner's space.
    """
    if owner.data.shape_keys is None:
        owner.shape_key_add(name="Basis", from_mix=False)
    key = owner.shape_key_add(name=name, from_mix=False)
    points = move(np.array([point.co for point in key.data]))
    key.data.foreach_set("co", points.astype(np.float32).ravel())
    return key


def drive(
    owner: bpy.types.bpy_struct,
    path: str,
    source: bpy.types.ID,
    read: str | tuple[str, str],
    expression: str = "value",
    index: int = -1,
) -> bpy.types.Driver:
    """Drive a property with an expression of `value`, and return the driver.

    Args:
        owner, path, index: the property; the index of an element of an array.
        source, read: what `value` is (`add_variable`).
        expression: the expression.
    """
    driver = owner.driver_add(path, index).driver
    add_variable(driver, "value", source, read)
    driver.expression = expression
    return driver


def add_variable(driver: bpy.types.Driver, name: str, source: bpy.types.ID, read: str | tuple[str, str]) -> None:
    """Add a variable to a driver.

    Args:
        source: the datablock that is read.
        read: the path of a number. Or, if the source is an object, the name of one of its bones ("" for the object) and
            a transform channel in local space, such as `("upper", "ROT_X")`.
    """
    variable = driver.variables.new()
    variable.name, variable.type = name, "SINGLE_PROP" if isinstance(read, str) else "TRANSFORMS"
    target = variable.targets[0]
    if isinstance(read, str):
        target.id_type, target.id, target.data_path = source.id_type, source, read
    else:
        target.id, (target.bone_target, target.transform_type) = source, read
        target.transform_space = "LOCAL_SPACE"


def bulge(points: np.ndarray) -> np.ndarray:
    """Move the points near the joint away from the axis of the tube by up to half their distance."""
    joint_proximity = np.exp(-(((points[:, :1] - JOINT) / 0.08) ** 2))
    return np.hstack([points[:, :1], points[:, 1:] * (1.0 + 0.5 * joint_proximity)])


def predicted_positions(scene_rig: SceneRig, network: Network) -> np.ndarray:
    """Return the model's positions (V, 3) for the evaluated pose, computed without the code for playback."""
    depsgraph, info = bpy.context.evaluated_depsgraph_get(), network.info
    reader = PoseReader(scene_rig, info.joint_names, info.rest_matrices)
    evaluated = (o.evaluated_get(depsgraph) for o in (scene_rig.mesh_object, scene_rig.armature_object))
    matrices = reader.read(*evaluated)
    controls = ControlReader(scene_rig, info.controls).read(scene_rig, depsgraph)
    return network.positions(matrices[None], controls[None])[0]
