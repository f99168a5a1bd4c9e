# SPDX-License-Identifier: GPL-3.0-or-later
"""Add clothes to a human with a Mixamo-style rig: `clothed_human.py IN.blend OUT.blend [NUMBER]`.

NUMBER is the number of garments, 2 by default and at most 10. Each is a copy of the faces of the body that follow the
covered bones. It is moved outward along the normals. A garment with few vertices is subdivided. It has copies of the
body's modifiers, so that all meshes follow one armature.
"""

import sys
from pathlib import Path

import bpy
import numpy as np

PREFIX = "mixamorig:"
CHEST = ("Spine", "Spine1", "Spine2", "LeftShoulder", "RightShoulder")
ARMS, LEGS = ("LeftArm", "RightArm"), ("Hips", "LeftUpLeg", "RightUpLeg", "LeftLeg", "RightLeg")
HAND = ("Hand", *(f"Hand{finger}{n}" for finger in ("Thumb", "Index", "Middle", "Ring", "Pinky") for n in (1, 2, 3)))
COVERED_BONES = {
    "shirt": (*CHEST, *ARMS),
    "trousers": LEGS,
    "vest": CHEST,
    "jacket": (*CHEST, *ARMS, "LeftForeArm", "RightForeArm"),
    "chaps": LEGS[1:],
    "hood": ("Head", "Neck"),
    "left glove": tuple(f"Left{bone}" for bone in HAND),
    "right glove": tuple(f"Right{bone}" for bone in HAND),
    "left boot": ("LeftFoot", "LeftToeBase", "LeftLeg"),
    "right boot": ("RightFoot", "RightToeBase", "RightLeg"),
}
"""The bones that each garment covers."""
DISTANCE_M = 0.012
"""Distance of the first garments from the body; each further pair lies farther outside."""
MIN_VERTICES = 1000
"""Garments with fewer vertices are subdivided once."""


def main_bones(body: bpy.types.Object) -> list[str]:
    """Return the bone with the largest skin weight for each vertex, without the name's prefix."""
    names = [group.name.removeprefix(PREFIX) for group in body.vertex_groups]
    return [names[max(v.groups, key=lambda g: g.weight).group] if v.groups else "" for v in body.data.vertices]


def add_piece(body: bpy.types.Object, name: str, bones: tuple[str, ...], distance_m: float) -> bpy.types.Object:
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
    offset = distance_m / body.matrix_world.median_scale
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
    if len(edited_mesh.verts) < MIN_VERTICES:
        bmesh.ops.subdivide_edges(edited_mesh, edges=edited_mesh.edges, cuts=1, use_grid_fill=True)
    edited_mesh.to_mesh(mesh)
    edited_mesh.free()


def main(source_path: Path, output_path: Path, count: int) -> None:
    """Add the clothes to the only mesh with an Armature modifier, and save."""
    bpy.ops.wm.open_mainfile(filepath=str(source_path.absolute()))
    meshes = [o for o in bpy.data.objects if o.type == "MESH" and any(m.type == "ARMATURE" for m in o.modifiers)]
    (body,) = meshes
    for index, (name, bones) in enumerate(list(COVERED_BONES.items())[:count]):
        piece = add_piece(body, name, bones, DISTANCE_M * (1 + index // 2))
        print(f"{name}: {len(piece.data.vertices):,} vertices")
    bpy.ops.wm.save_as_mainfile(filepath=str(output_path.absolute()), copy=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 2)
