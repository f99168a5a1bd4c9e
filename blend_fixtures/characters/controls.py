# SPDX-License-Identifier: GPL-3.0-or-later
"""Build characters with inputs beside their joints; each function builds one from the tube of `base`."""

import bpy

from .base import add_key, add_lattice, bulge, drive, link, tube
from .bones import NewBone, add_bones, add_delta_mush


def custom_property() -> None:
    """Build a tube with a custom property of the armature object that drives a shape key."""
    mesh_object, armature_object = tube()
    add_property(armature_object, "flex")
    drive(add_key(mesh_object, "flexed", bulge), "value", armature_object, '["flex"]')
    add_delta_mush(mesh_object)


def free_shape_keys() -> None:
    """Build a tube with two shape keys that an animator sets by hand, and with delta mush."""
    mesh_object, _ = tube()
    add_key(mesh_object, "flexed", bulge)
    add_key(mesh_object, "thin", lambda points: points * (1.0, 0.7, 0.7)).slider_min = -0.5
    add_delta_mush(mesh_object)


def constraint_influence() -> None:
    """Build a tube with a constraint whose influence affects the rotation of a bone and drives a shape key."""
    mesh_object, armature_object = tube()
    add_bones(armature_object, NewBone("rest", (0.25, 0.0, 0.1), (0.5, 0.0, 0.1), is_deforming=False))
    copy = armature_object.pose.bones["lower"].constraints.new("COPY_ROTATION")
    copy.name, copy.target, copy.subtarget, copy.influence = "Rest", armature_object, "rest", 0.0
    path = 'pose.bones["lower"].constraints["Rest"].influence'
    drive(add_key(mesh_object, "flexed", bulge), "value", armature_object, path)
    add_delta_mush(mesh_object)


def modifier_strength() -> None:
    """Build a tube with a custom property of the mesh object that drives the strength of a modifier."""
    mesh_object, _ = tube()
    add_property(mesh_object, "softness")
    modifier = mesh_object.modifiers.new("Smooth", "SMOOTH")
    modifier.iterations = 6
    drive(modifier, "factor", mesh_object, '["softness"]')


def undriven_strength() -> None:
    """Build a tube with a modifier whose strength an animator sets by hand."""
    mesh_object, _ = tube()
    add_cast(mesh_object)


def lattice_shape_key() -> None:
    """Build a tube that a lattice deforms before the skinning; an animator sets the lattice's shape key by hand."""
    mesh_object, _ = tube()
    add_key(add_lattice(mesh_object), "thick", lambda points: points * (1.0, 1.5, 1.5))
    add_delta_mush(mesh_object)


def dial() -> None:
    """Build a tube with a shape key that the X location of another object drives."""
    mesh_object, _ = tube()
    dial_object = link(bpy.data.objects.new("dial", None))
    drive(add_key(mesh_object, "flexed", bulge), "value", dial_object, ("", "LOC_X"), "2 * value")
    add_delta_mush(mesh_object)


def add_cast(mesh_object: bpy.types.Object) -> bpy.types.CastModifier:
    """Add a Cast modifier with strength 0."""
    modifier = mesh_object.modifiers.new("Cast", "CAST")
    modifier.use_radius_as_size, modifier.size, modifier.factor = False, 0.3, 0.0
    return modifier


def add_property(owner: bpy.types.ID, name: str) -> None:
    """Add a custom property with the range 0 to 1 to a datablock."""
    owner[name] = 0.0
    owner.id_properties_ui(name).update(min=0.0, max=1.0)
    # Without the tag, a driver that reads the property before the next depsgraph update is marked invalid.
    owner.update_tag()
