# SPDX-License-Identifier: GPL-3.0-or-later
"""Build characters with many kinds of deforming modifiers; each function builds one in the current scene."""

from collections.abc import Callable
from itertools import pairwise

import bpy
import numpy as np

from blend_fixtures.elbow import skin

from .base import BEND, add_driven_key, add_lattice, bulge, cage, drive, link, tube


def corrective_smooth() -> None:
    """Build a tube with delta mush that is bound to the rest pose."""
    mesh_object, _ = tube()
    modifier = mesh_object.modifiers.new("Mush", "CORRECTIVE_SMOOTH")
    modifier.rest_source, modifier.iterations = "BIND", 8
    _bind(mesh_object, modifier, bpy.ops.object.correctivesmooth_bind)


def lattice() -> None:
    """Build a tube that a lattice deforms before the skinning; the elbow drives a shape key of the lattice."""
    mesh_object, armature_object = tube()
    add_driven_key(add_lattice(mesh_object), armature_object, lambda points: points * (1.0, 1.4, 1.4))


def mesh_deform() -> None:
    """Build a tube that a bulging cage deforms before the skinning."""
    mesh_object, armature_object = tube()
    target = cage("cage", 1.4)
    add_driven_key(target, armature_object, bulge)
    modifier = mesh_object.modifiers.new("MeshDeform", "MESH_DEFORM")
    modifier.object, modifier.precision = target, 4
    _move_first(mesh_object, modifier)
    _bind(mesh_object, modifier, bpy.ops.object.meshdeform_bind)


def surface_deform() -> None:
    """Build a mesh that is bound to the surface of another mesh, which is skinned and smoothed."""
    mesh_object, armature_object = tube()
    target = cage("body", 1.1)
    skin(target, armature_object)
    _smooth(target)
    modifier = mesh_object.modifiers.new("SurfaceDeform", "SURFACE_DEFORM")
    modifier.target = target
    _bind(mesh_object, modifier, bpy.ops.object.surfacedeform_bind)


def shrinkwrap() -> None:
    """Build a sleeve with a Shrinkwrap onto a body that is skinned and smoothed."""
    mesh_object, armature_object = tube()
    target = cage("body", 0.9)
    skin(target, armature_object)
    _smooth(target)
    modifier = mesh_object.modifiers.new("Shrinkwrap", "SHRINKWRAP")
    modifier.target, modifier.offset = target, 0.003


def smooth() -> None:
    """Build a tube with a Smooth modifier after the skinning."""
    _smooth(tube()[0])


def laplacian_smooth() -> None:
    """Build a tube with a Laplacian Smooth modifier after the skinning."""
    mesh_object, _ = tube()
    modifier = mesh_object.modifiers.new("LaplacianSmooth", "LAPLACIANSMOOTH")
    modifier.iterations, modifier.lambda_factor = 2, 0.5


def laplacian_deform() -> None:
    """Build a tube with skinned ends; Laplacian Deform moves the surface between them."""
    mesh_object, _ = tube()
    anchors = mesh_object.vertex_groups.new(name="anchors")
    x_positions = np.array([vertex.co.x for vertex in mesh_object.data.vertices])
    anchors.add(np.flatnonzero((x_positions < 0.18) | (x_positions > 0.32)).tolist(), 1.0, "REPLACE")
    modifier = mesh_object.modifiers.new("LaplacianDeform", "LAPLACIANDEFORM")
    modifier.vertex_group, modifier.iterations = "anchors", 2
    _bind(mesh_object, modifier, bpy.ops.object.laplaciandeform_bind)


def hook() -> None:
    """Build a tube with a hook at the surface above the joint; the hooked empty is a child of the lower bone."""
    mesh_object, armature_object = tube()
    empty = link(bpy.data.objects.new("handle", None))
    empty.parent, empty.parent_type, empty.parent_bone = armature_object, "BONE", "lower"
    bpy.context.view_layer.update()
    empty.matrix_world = ((1, 0, 0, 0.3), (0, 1, 0, 0), (0, 0, 1, 0.03), (0, 0, 0, 1))
    modifier = mesh_object.modifiers.new("Hook", "HOOK")
    modifier.object, modifier.falloff_radius, modifier.strength = empty, 0.15, 0.5
    modifier.center = (0.2, 0.0, 0.04)
    modifier.matrix_inverse = empty.matrix_world.inverted()
    x_positions = np.array([vertex.co.x for vertex in mesh_object.data.vertices])
    modifier.vertex_indices_set(np.flatnonzero((x_positions > 0.1) & (x_positions < 0.24)).tolist())


def cast() -> None:
    """Build a tube with a Cast modifier after the skinning."""
    mesh_object, _ = tube()
    modifier = mesh_object.modifiers.new("Cast", "CAST")
    modifier.factor, modifier.size, modifier.use_radius_as_size = 0.2, 0.3, False


def curve() -> None:
    """Build a tube that a curve deforms before the skinning; the elbow drives a sagging shape key of the curve."""
    mesh_object, armature_object = tube()
    data = bpy.data.curves.new("path", "CURVE")
    data.dimensions = "3D"
    spline = data.splines.new("POLY")
    spline.points.add(6)
    for index, point in enumerate(spline.points):
        point.co = (index * 0.1, 0.0, 0.0, 1.0)
    path = link(bpy.data.objects.new("path", data))

    def sag(points: np.ndarray) -> np.ndarray:
        return points - np.outer(np.sin(points[:, 0] / 0.6 * np.pi), (0.0, 0.0, 0.05))

    add_driven_key(path, armature_object, sag)
    modifier = mesh_object.modifiers.new("Curve", "CURVE")
    modifier.object = path
    _move_first(mesh_object, modifier)


def geometry_nodes() -> None:
    """Build a tube with a node group that moves vertices by their position after the skinning."""
    mesh_object, _ = tube()
    mesh_object.modifiers.new("Ripple", "NODES").node_group = ripple_group()


def shape_keys() -> None:
    """Build a tube with a shape key that the bend of the elbow drives, a muted shape key, and Preserve Volume."""
    mesh_object, armature_object = tube()
    add_driven_key(mesh_object, armature_object, bulge)
    muted_key = add_driven_key(mesh_object, armature_object, lambda points: points * 3.0)
    muted_key.mute = True
    mesh_object.modifiers["Armature"].use_deform_preserve_volume = True


def absolute_shape_keys() -> None:
    """Build a tube with absolute shape keys whose evaluation time is driven."""
    mesh_object, armature_object = tube()
    mesh_object.shape_key_add(name="Basis", from_mix=False)
    thick_key = mesh_object.shape_key_add(name="thick", from_mix=False)
    points = np.array([point.co for point in thick_key.data])
    thick_key.data.foreach_set("co", bulge(points).astype(np.float32).ravel())
    keys = mesh_object.data.shape_keys
    keys.use_relative = False
    # Blender spaces absolute shape keys ten frames apart.
    drive(keys, "eval_time", armature_object, BEND, "10 * value")


def displace() -> None:
    """Build a tube with a Displace modifier along the normals after the skinning."""
    tube()[0].modifiers.new("Displace", "DISPLACE").strength = 0.01


def simple_deform() -> None:
    """Build a tube that is twisted after the skinning."""
    modifier = tube()[0].modifiers.new("Twist", "SIMPLE_DEFORM")
    modifier.deform_method, modifier.deform_axis, modifier.angle = "TWIST", "X", 0.5


def warp() -> None:
    """Build a tube with a Warp modifier near the joint, from one empty to another."""
    mesh_object, _ = tube()
    empties = [link(bpy.data.objects.new(name, None)) for name in ("from", "to")]
    for empty, height in zip(empties, (0.0, 0.03), strict=True):
        empty.location = (0.3, 0.0, height)
    modifier = mesh_object.modifiers.new("Warp", "WARP")
    modifier.object_from, modifier.object_to, modifier.falloff_radius = *empties, 0.2


def subdivided() -> None:
    """Build a tube with delta mush, followed by modifiers that add vertices: Subdivision, Solidify and nodes."""
    corrective_smooth()
    mesh_object = bpy.data.objects["elbow"]
    mesh_object.modifiers.new("Subdivision", "SUBSURF")
    mesh_object.modifiers.new("Thickness", "SOLIDIFY").thickness = 0.004
    mesh_object.modifiers.new("Detail", "NODES").node_group = subdividing_group()


STACKS: tuple[Callable[[], None], ...] = (
    corrective_smooth, lattice, mesh_deform, surface_deform, shrinkwrap, smooth, laplacian_smooth, laplacian_deform,
    hook, cast, curve, geometry_nodes, shape_keys, absolute_shape_keys, displace, simple_deform, warp, subdivided,
)  # fmt: skip


def ripple_group() -> bpy.types.NodeTree:
    """Build a node group that moves each vertex by some millimeters, in a direction that depends on its position."""
    group = build_node_chain("Ripple", "GeometryNodeSetPosition")
    position, sine, offset_scale = (
        group.nodes.new(node_type) for node_type in ("GeometryNodeInputPosition", *["ShaderNodeVectorMath"] * 2)
    )
    position_scale = group.nodes.new("ShaderNodeVectorMath")
    position_scale.operation, sine.operation, offset_scale.operation = "SCALE", "SINE", "SCALE"
    position_scale.inputs["Scale"].default_value, offset_scale.inputs["Scale"].default_value = 30.0, 0.003
    for source, target in (
        (position.outputs[0], position_scale.inputs[0]),
        (position_scale.outputs[0], sine.inputs[0]),
        (sine.outputs[0], offset_scale.inputs[0]),
        (offset_scale.outputs[0], group.nodes["Set Position"].inputs["Offset"]),
    ):
        group.links.new(source, target)
    return group


def subdividing_group() -> bpy.types.NodeTree:
    """Build a node group that subdivides each face into four."""
    return build_node_chain("Subdivide", "GeometryNodeSubdivideMesh")


def build_node_chain(name: str, *node_types: str) -> bpy.types.NodeTree:
    """Build a node group that passes its geometry through nodes of the given types in this order."""
    group = bpy.data.node_groups.new(name, "GeometryNodeTree")
    for in_out in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=in_out, socket_type="NodeSocketGeometry")
    for node_type in ("NodeGroupInput", *node_types, "NodeGroupOutput"):
        group.nodes.new(node_type)
    link_geometry_sockets(group)
    return group


def link_geometry_sockets(group: bpy.types.NodeTree) -> None:
    """Link the geometry sockets of each node of a group with those of the next node."""
    for node, next_node in pairwise(group.nodes):
        source = next((socket for socket in node.outputs if socket.type == "GEOMETRY"), None)
        target = next((socket for socket in next_node.inputs if socket.type == "GEOMETRY"), None)
        if source and target:
            group.links.new(source, target)


def _smooth(mesh_object: bpy.types.Object) -> None:
    modifier = mesh_object.modifiers.new("Smooth", "SMOOTH")
    modifier.factor, modifier.iterations = 0.5, 4


def _move_first(mesh_object: bpy.types.Object, modifier: bpy.types.Modifier) -> None:
    mesh_object.modifiers.move(mesh_object.modifiers.find(modifier.name), 0)


def _bind(mesh_object: bpy.types.Object, modifier: bpy.types.Modifier, operator: Callable) -> None:
    """Run the operator that binds a modifier to the rest pose."""
    bpy.context.view_layer.update()
    with bpy.context.temp_override(object=mesh_object, active_object=mesh_object):
        operator(modifier=modifier.name)
