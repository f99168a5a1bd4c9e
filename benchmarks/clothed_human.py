# SPDX-License-Identifier: GPL-3.0-or-later
"""Dresses a human with a Mixamo-style rig: `clothed_human.py IN.blend OUT.blend`.

A shirt and trousers are made of the faces of the body that follow the bones they cover, pushed outwards along the
normals. They follow the same armature, through modifiers like the body's: three meshes on one armature.
"""

import sys
from pathlib import Path

import bpy
import numpy as np

PREFIX = "mixamorig:"
CLOTHES = {
    "shirt": ("Spine", "Spine1", "Spine2", "LeftShoulder", "RightShoulder", "LeftArm", "RightArm"),
    "trousers": ("Hips", "LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg"),
}
"""The bones that each piece covers."""
THICKNESS = 0.012
"""How far a piece lies over the body, meters."""


def main_bones(body: bpy.types.Object) -> list[str]:
    """The bone with the largest weight of each vertex, without its prefix."""
    names = [group.name.removeprefix(PREFIX) for group in body.vertex_groups]
    return [names[max(v.groups, key=lambda g: g.weight).group] if v.groups else "" for v in body.data.vertices]


def add_piece(body: bpy.types.Object, name: str, bones: tuple[str, ...]) -> bpy.types.Object:
    """A copy of the body, cut down to what follows some bones and pushed outwards."""
    bones_of = main_bones(body)
    kept = {index for index, bone in enumerate(bones_of) if bone in bones}
    piece = body.copy()
    piece.name, piece.data = name, body.data.copy()
    body.users_collection[0].objects.link(piece)
    mesh = piece.data
    normals, positions = (np.empty(len(mesh.vertices) * 3, np.float32) for _ in range(2))
    mesh.vertex_normals.foreach_get("vector", normals)
    mesh.vertices.foreach_get("co", positions)
    scale = THICKNESS / body.matrix_world.median_scale
    mesh.vertices.foreach_set("co", positions + normals * scale)
    _remove_vertices(mesh, [index for index in range(len(bones_of)) if index not in kept])
    return piece


def _remove_vertices(mesh: bpy.types.Mesh, indices: list[int]) -> None:
    import bmesh

    work = bmesh.new()
    work.from_mesh(mesh)
    work.verts.ensure_lookup_table()
    bmesh.ops.delete(work, geom=[work.verts[index] for index in indices], context="VERTS")
    loose = [vertex for vertex in work.verts if not vertex.link_faces]
    bmesh.ops.delete(work, geom=loose, context="VERTS")
    work.to_mesh(mesh)
    work.free()


def main(source: Path, target: Path) -> None:
    """Dress the only mesh with an Armature modifier, and save."""
    bpy.ops.wm.open_mainfile(filepath=str(source.absolute()))
    meshes = [o for o in bpy.data.objects if o.type == "MESH" and any(m.type == "ARMATURE" for m in o.modifiers)]
    (body,) = meshes
    for name, bones in CLOTHES.items():
        piece = add_piece(body, name, bones)
        print(f"{name}: {len(piece.data.vertices):,} vertices")
    bpy.ops.wm.save_as_mainfile(filepath=str(target.absolute()), copy=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
