# SPDX-License-Identifier: GPL-3.0-or-later
"""Add clothes to a human with a Mixamo-style rig: `clothed_human.py IN.blend OUT.blend`.

The shirt and the trousers are copies of the body's faces that follow the covered bones, moved outward along the
normals. Their modifiers are copies of the body's, so that three meshes follow one armature.
"""

import sys
from pathlib import Path

import bpy
import numpy as np

PREFIX = "mixamorig:"
COVERED_BONES = {
    "shirt": ("Spine", "Spine1", "Spine2", "LeftShoulder", "RightShoulder", "LeftArm", "RightArm"),
    "trousers": ("Hips", "LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg"),
}
"""The bones that each piece of clothing covers."""
DISTANCE_FROM_BODY_M = 0.012


def main_bones(body: bpy.types.Object) -> list[str]:
    """Return the bone with the largest skin weight for each vertex, without the name's prefix."""
    names = [group.name.removeprefix(PREFIX) for group in body.vertex_groups]
    return [names[max(v.groups, key=lambda g: g.weight).group] if v.groups else "" for v in body.data.vertices]


def add_piece(body: bpy.types.Object, name: str, bones: tuple[str, ...]) -> bpy.types.Object:
    """Copy the part of the body that follows the given bones, moved outward."""
    vertex_bones = main_bones(body)
    kept_vertices = {index for index, bone in enumerate(vertex_bones) if bone in bones}
    piece = body.copy()
    piece.name, piece.data = name, body.data.copy()
    body.users_collection[0].objects.link(piece)
    mesh = piece.data
    normals, positions = (np.empty(len(mesh.vertices) * 3, np.float32) for _ in range(2))
    mesh.vertex_normals.foreach_get("vector", normals)
    mesh.vertices.foreach_get("co", positions)
    offset = DISTANCE_FROM_BODY_M / body.matrix_world.median_scale
    mesh.vertices.foreach_set("co", positions + normals * offset)
    _remove_vertices(mesh, [index for index in range(len(vertex_bones)) if index not in kept_vertices])
    return piece


def _remove_vertices(mesh: bpy.types.Mesh, indices: list[int]) -> None:
    import bmesh

    edited_mesh = bmesh.new()
    edited_mesh.from_mesh(mesh)
    edited_mesh.verts.ensure_lookup_table()
    bmesh.ops.delete(edited_mesh, geom=[edited_mesh.verts[index] for index in indices], context="VERTS")
    loose = [vertex for vertex in edited_mesh.verts if not vertex.link_faces]
    bmesh.ops.delete(edited_mesh, geom=loose, context="VERTS")
    edited_mesh.to_mesh(mesh)
    edited_mesh.free()


def main(source_path: Path, output_path: Path) -> None:
    """Add the clothes to the only mesh with an Armature modifier, and save."""
    bpy.ops.wm.open_mainfile(filepath=str(source_path.absolute()))
    meshes = [o for o in bpy.data.objects if o.type == "MESH" and any(m.type == "ARMATURE" for m in o.modifiers)]
    (body,) = meshes
    for name, bones in COVERED_BONES.items():
        piece = add_piece(body, name, bones)
        print(f"{name}: {len(piece.data.vertices):,} vertices")
    bpy.ops.wm.save_as_mainfile(filepath=str(output_path.absolute()), copy=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
