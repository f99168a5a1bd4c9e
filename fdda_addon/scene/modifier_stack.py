# SPDX-License-Identifier: GPL-3.0-or-later
"""The modifiers of a rig: which of them a model replaces, and which stay. numpy is not needed."""

from collections.abc import Iterable

import bpy

from ..core.errors import RigError
from .scene_rig import MODIFIER_NAME, SceneRig, armature_modifier

DEFORMING = {
    "ARMATURE", "CAST", "CLOTH", "CORRECTIVE_SMOOTH", "CURVE", "DISPLACE", "HOOK", "LAPLACIANDEFORM",
    "LAPLACIANSMOOTH", "LATTICE", "MESH_CACHE", "MESH_DEFORM", "MESH_SEQUENCE_CACHE", "SHRINKWRAP", "SIMPLE_DEFORM",
    "SMOOTH", "SOFT_BODY", "SURFACE_DEFORM", "VOLUME_DISPLACE", "WARP", "WAVE",
}  # fmt: skip
TOPOLOGY_CHANGING = {
    "ARRAY", "BEVEL", "BOOLEAN", "BUILD", "DECIMATE", "EDGE_SPLIT", "EXPLODE", "FLUID", "MASK", "MIRROR", "MULTIRES",
    "OCEAN", "REMESH", "SCREW", "SKIN", "SOLIDIFY", "SUBSURF", "VOLUME_TO_MESH", "WELD", "WIREFRAME",
}  # fmt: skip


def check_evaluable(scene_rig: SceneRig) -> None:
    """Fail when what the graph evaluates the mesh to could not be compared with the mesh.

    Raises:
        RigError: edit mode, the NLA's tweak mode, a hidden object, an Armature modifier that is off, or a modifier
            that changes the topology.
    """
    mesh_object = scene_rig.mesh_object
    check_posable(scene_rig)
    check_topology(mesh_object, mesh_object.modifiers)
    if not armature_modifier(mesh_object).show_viewport:
        raise RigError(f"The Armature modifier of '{mesh_object.name}' is switched off in the viewport; switch it on.")
    count = len(mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.vertices)
    if count != len(mesh_object.data.vertices):
        nodes = [m.name for m in mesh_object.modifiers if m.type not in DEFORMING and m.show_viewport]
        raise RigError(
            f"The modifiers of '{mesh_object.name}' turn {len(mesh_object.data.vertices)} vertices into {count}; "
            f"switch off the one that changes the topology ({', '.join(nodes)})."
        )


def check_posable(scene_rig: SceneRig) -> None:
    """Fail when the poses of a rig could not be read frame by frame, whatever its modifiers do.

    Raises:
        RigError: edit mode, the NLA's tweak mode, an armature that shows its rest position, or a hidden object.
    """
    mesh_object, armature_object = scene_rig.mesh_object, scene_rig.armature_object
    if mesh_object.mode == "EDIT" or armature_object.mode == "EDIT":
        raise RigError(f"'{mesh_object.name}' or its armature is in edit mode; leave it first.")
    animation = armature_object.animation_data
    if animation is not None and animation.use_tweak_mode:
        raise RigError(f"'{armature_object.name}' is in tweak mode of the NLA editor; leave it first.")
    if armature_object.data.pose_position == "REST":
        raise RigError(f"The armature '{armature_object.name}' shows its rest position; set it to pose.")
    if not mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get()).is_evaluated:
        raise RigError(f"'{mesh_object.name}' is hidden, so Blender does not evaluate it; show it in the viewport.")


def check_topology(mesh_object: bpy.types.Object, modifiers: Iterable[bpy.types.Modifier]) -> None:
    """Fail when one of these modifiers of a mesh object is on and makes other vertices of those of the mesh.

    Raises:
        RigError: names it.
    """
    for modifier in modifiers:
        if modifier.type in TOPOLOGY_CHANGING and modifier.show_viewport:
            raise RigError(
                f"Modifier '{modifier.name}' of '{mesh_object.name}' changes the topology of the mesh, so its vertices "
                "cannot be followed; switch it off in the viewport, or apply it."
            )


def deforming_modifiers(mesh_object: bpy.types.Object) -> list[bpy.types.Modifier]:
    """The modifiers of the rig that move vertices, in their order, switched on or not. Geometry Nodes count too."""
    return [
        modifier
        for modifier in mesh_object.modifiers
        if modifier.type in DEFORMING or (modifier.type == "NODES" and modifier.name != MODIFIER_NAME)
    ]
