# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters with inputs beside their joints: one function each, which builds a tube as in `base`."""

from collections.abc import Callable

import bpy
import numpy as np

from .base import bulge, link, tube
from .bones import NewBone, add_bones, mush


def custom_property() -> None:
    """A custom property of the armature object, which the driver of a shape key reads."""
    mesh_object, armature_object = tube()
    add_property(armature_object, "flex")
    follow(add_key(mesh_object, "flexed", bulge), "value", armature_object, '["flex"]')
    mush(mesh_object)


def free_shape_keys() -> None:
    """Two shape keys that an animator sets by hand, and delta mush."""
    mesh_object, _ = tube()
    add_key(mesh_object, "flexed", bulge)
    add_key(mesh_object, "thin", lambda points: points * (1.0, 0.7, 0.7)).slider_min = -0.5
    mush(mesh_object)


def constraint_influence() -> None:
    """The influence of a constraint: it turns a bone, and the driver of a shape key reads it."""
    mesh_object, armature_object = tube()
    add_bones(armature_object, NewBone("rest", (0.25, 0.0, 0.1), (0.5, 0.0, 0.1), is_deforming=False))
    copy = armature_object.pose.bones["lower"].constraints.new("COPY_ROTATION")
    copy.name, copy.target, copy.subtarget, copy.influence = "Rest", armature_object, "rest", 0.0
    path = 'pose.bones["lower"].constraints["Rest"].influence'
    follow(add_key(mesh_object, "flexed", bulge), "value", armature_object, path)
    mush(mesh_object)


def modifier_strength() -> None:
    """A custom property of the mesh object, which drives the strength of a modifier."""
    mesh_object, _ = tube()
    add_property(mesh_object, "softness")
    modifier = mesh_object.modifiers.new("Smooth", "SMOOTH")
    modifier.iterations = 6
    follow(modifier, "factor", mesh_object, '["softness"]')


def undriven_strength() -> None:
    """The strength of a modifier that an animator sets by hand."""
    mesh_object, _ = tube()
    modifier = mesh_object.modifiers.new("Cast", "CAST")
    modifier.use_radius_as_size, modifier.size, modifier.factor = False, 0.3, 0.0


def lattice_shape_key() -> None:
    """A shape key of a lattice that an animator sets by hand, before the skinning."""
    mesh_object, _ = tube()
    data = bpy.data.lattices.new("lattice")
    data.points_u, data.points_v, data.points_w = 6, 3, 3
    lattice_object = link(bpy.data.objects.new("lattice", data))
    lattice_object.location, lattice_object.scale = (0.25, 0.0, 0.0), (0.6, 0.15, 0.15)
    add_key(lattice_object, "thick", lambda points: points * (1.0, 1.5, 1.5))
    mesh_object.modifiers.new("Lattice", "LATTICE").object = lattice_object
    mesh_object.modifiers.move(1, 0)
    mush(mesh_object)


def dial() -> None:
    """Another object, whose place along X the driver of a shape key reads."""
    mesh_object, _ = tube()
    dial_object = link(bpy.data.objects.new("dial", None))
    driver = add_key(mesh_object, "flexed", bulge).driver_add("value").driver
    variable = driver.variables.new()
    variable.name, variable.type = "place", "TRANSFORMS"
    variable.targets[0].id, variable.targets[0].transform_type = dial_object, "LOC_X"
    driver.expression = "2 * place"
    mush(mesh_object)


CONTROLS: tuple[Callable[[], None], ...] = (
    custom_property, free_shape_keys, constraint_influence, modifier_strength, undriven_strength, lattice_shape_key,
    dial,
)  # fmt: skip


def add_property(owner: bpy.types.ID, name: str) -> None:
    """Give a datablock a custom property from 0 to 1."""
    owner[name] = 0.0
    owner.id_properties_ui(name).update(min=0.0, max=1.0)
    # Else a driver that reads it before Blender knows of it is taken for broken.
    owner.update_tag()


def add_key(owner: bpy.types.Object, name: str, move: Callable[[np.ndarray], np.ndarray]) -> bpy.types.ShapeKey:
    """Add a shape key.

    Args:
        owner: a mesh or lattice object.
        name: of the key.
        move: points of the basis to those of the key, (n, 3) each, the owner's space.
    """
    if owner.data.shape_keys is None:
        owner.shape_key_add(name="Basis", from_mix=False)
    key = owner.shape_key_add(name=name, from_mix=False)
    points = move(np.array([point.co for point in key.data]))
    key.data.foreach_set("co", points.astype(np.float32).ravel())
    return key


def follow(owner: bpy.types.bpy_struct, attribute: str, source: bpy.types.ID, path: str) -> None:
    """Drive a number by another one, as it is."""
    driver = owner.driver_add(attribute).driver
    variable = driver.variables.new()
    variable.name = "value"
    variable.targets[0].id, variable.targets[0].data_path = source, path
    driver.expression = "value"
