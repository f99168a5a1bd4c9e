# SPDX-License-Identifier: GPL-3.0-or-later
"""Build characters with several meshes, with many bones or without weights; each function builds one."""

import bpy
import numpy as np

from blend_fixtures.elbow import END, START, skin

from .base import cage, link, tube
from .bones import NewBone, add_bones, add_delta_mush, limit

CHAINS, BONES_PER_CHAIN = 25, 20
"""Number of chains and of bones per chain of the creature with 500 bones."""


def body_and_sleeve() -> None:
    """Build two meshes on one armature: the tube with delta mush, and the object `sleeve` with a Shrinkwrap onto it."""
    mesh_object, armature_object = tube()
    add_delta_mush(mesh_object)
    sleeve = cage("sleeve", 1.15)
    skin(sleeve, armature_object)
    add_delta_mush(sleeve, 10)
    modifier = sleeve.modifiers.new("Shrinkwrap", "SHRINKWRAP")
    modifier.target, modifier.offset = mesh_object, 0.004


def dressed_limb() -> None:
    """Build a body, a sleeve with weights, and the object `cuff`, which is elsewhere and follows the body's surface.

    The cuff has no weights: a Surface Deform modifier binds it. Body and sleeve have shape keys of one name.
    """
    body_and_sleeve()
    body, sleeve = bpy.data.objects["elbow"], bpy.data.objects["sleeve"]
    for mesh_object, size in ((body, 1.1), (sleeve, 1.05)):
        mesh_object.shape_key_add(name="Basis", from_mix=False)
        for point in mesh_object.shape_key_add(name="puff", from_mix=False).data:
            point.co.yz *= size
    cuff = cage("cuff", 1.3)
    sleeve.parent = cuff.parent = bpy.data.objects["elbow_rig"]
    cuff.location, cuff.rotation_euler, cuff.scale = (0.03, -0.02, 0.01), (0.4, 0.0, 0.2), (2.0, 2.0, 2.0)
    bpy.context.view_layer.update()
    cuff.data.transform(cuff.matrix_world.inverted())
    modifier = cuff.modifiers.new("SurfaceDeform", "SURFACE_DEFORM")
    modifier.target = body
    with bpy.context.temp_override(object=cuff, active_object=cuff):
        bpy.ops.object.surfacedeform_bind(modifier=modifier.name)
    if not modifier.is_bound:
        raise RuntimeError("the cuff is not bound")


def through_a_lattice() -> None:
    """Build a tube without weights inside a lattice whose points follow the bones."""
    mesh_object, armature_object = tube()
    mesh_object.modifiers.clear()
    mesh_object.vertex_groups.clear()
    mesh_object.parent = None
    data = bpy.data.lattices.new("lattice")
    data.points_u, data.points_v, data.points_w = 9, 3, 3
    # With Blender's default interpolation, the mesh rotates less than the points of the lattice.
    for axis in "uvw":
        setattr(data, f"interpolation_type_{axis}", "KEY_LINEAR")
    lattice_object = link(bpy.data.objects.new("lattice", data))
    lattice_object.location, lattice_object.scale = ((START + END) / 2, 0.0, 0.0), (0.56, 0.15, 0.15)
    x_positions = np.array([point.co_deform.x for point in data.points])
    lower_weights = np.clip(x_positions / 0.4 + 0.5, 0.0, 1.0)
    for name, weights in (("upper", 1.0 - lower_weights), ("lower", lower_weights)):
        group = lattice_object.vertex_groups.new(name=name)
        for point in np.flatnonzero(weights):
            group.add([int(point)], float(weights[point]), "REPLACE")
    lattice_object.modifiers.new("Armature", "ARMATURE").object = armature_object
    mesh_object.modifiers.new("Lattice", "LATTICE").object = lattice_object


def five_hundred_bones() -> None:
    """Build a creature of 25 strips with delta mush; each strip has a chain of 20 bones and 84 vertices."""
    armature_object = link(bpy.data.objects.new("creature_rig", bpy.data.armatures.new("creature_rig")))
    length = (END - START) / BONES_PER_CHAIN
    add_bones(
        armature_object,
        *(
            NewBone(
                _bone_name(chain, index),
                (index * length, chain * 0.05, 0.0),
                ((index + 1) * length, chain * 0.05, 0.0),
                _bone_name(chain, index - 1) if index else "",
                is_connected=index > 0,
            )
            for chain in range(CHAINS)
            for index in range(BONES_PER_CHAIN)
        ),
    )
    for bone in armature_object.pose.bones:
        limit(bone, "LIMIT_ROTATION", {axis: (-12.0, 12.0) for axis in (0, 2)})
    mesh_object = link(bpy.data.objects.new("creature", _build_strips(length)))
    mesh_object.parent = armature_object
    for chain in range(CHAINS):
        for index in range(BONES_PER_CHAIN):
            group = mesh_object.vertex_groups.new(name=_bone_name(chain, index))
            first_vertex = (chain * (BONES_PER_CHAIN + 1) + index) * 4
            group.add(range(first_vertex, first_vertex + 4), 0.5 if index else 1.0, "REPLACE")
            group.add(range(first_vertex + 4, first_vertex + 8), 0.5 if index + 1 < BONES_PER_CHAIN else 1.0, "REPLACE")
    mesh_object.modifiers.new("Armature", "ARMATURE").object = armature_object
    add_delta_mush(mesh_object, 3)


def _bone_name(chain: int, index: int) -> str:
    return f"finger.{chain:02}.{index:02}"


def _build_strips(length: float) -> bpy.types.Mesh:
    """Build one square tube per chain, with a ring of four vertices at each end of a bone."""
    ring = np.array([(0.0, y, z) for y, z in ((-0.01, -0.01), (0.01, -0.01), (0.01, 0.01), (-0.01, 0.01))])
    points = [
        ring + np.array((index * length, chain * 0.05, 0.0))
        for chain in range(CHAINS)
        for index in range(BONES_PER_CHAIN + 1)
    ]
    faces = []
    for chain in range(CHAINS):
        for index in range(BONES_PER_CHAIN):
            first_vertex = (chain * (BONES_PER_CHAIN + 1) + index) * 4
            faces += [
                (first_vertex + k, first_vertex + (k + 1) % 4, first_vertex + (k + 1) % 4 + 4, first_vertex + k + 4)
                for k in range(4)
            ]
    mesh = bpy.data.meshes.new("creature")
    mesh.from_pydata(np.concatenate(points).tolist(), [], faces)
    mesh.update()
    return mesh
