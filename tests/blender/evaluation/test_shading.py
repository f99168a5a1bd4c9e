# SPDX-License-Identifier: GPL-3.0-or-later
"""Normals and edges are those of Blender, on its own meshes and in an evaluation."""

import json

import bmesh
import bpy
import numpy as np
import pytest

from fdda_addon.core.mathematics.surface import Surface
from fdda_addon.rig.reading import read_rig
from fdda_addon.scene.mesh import topology

from ..conftest import run, train

EDGES = ["across", "beside", "inside", "ratio"]
APPROXIMATE = 0.05
"""Degrees. Blender computes normals in float32 and the angles of corners by a polynomial."""


def blender_normals(mesh: bpy.types.Mesh) -> np.ndarray:
    """(V, 3) vertex normals as Blender has them."""
    normals = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertex_normals.foreach_get("vector", normals)
    assert np.allclose(normals[:3], mesh.vertices[0].normal[:])
    return normals.reshape(-1, 3)


def degrees(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(first - second, axis=1) / 2, 0, 1)))


def positions_of(mesh: bpy.types.Mesh) -> np.ndarray:
    return np.array([vertex.co[:] for vertex in mesh.vertices], np.float32)


@pytest.mark.parametrize("shape", ["monkey", "cone", "sphere", "grid"])
def test_normals_and_edges_of_blender_s_own_meshes(shape):
    {
        "monkey": bpy.ops.mesh.primitive_monkey_add,
        "cone": lambda: bpy.ops.mesh.primitive_cone_add(vertices=7, end_fill_type="NGON"),
        "sphere": lambda: bpy.ops.mesh.primitive_uv_sphere_add(segments=12, ring_count=6),
        "grid": lambda: bpy.ops.mesh.primitive_grid_add(x_subdivisions=8, y_subdivisions=5),
    }[shape]()
    mesh = bpy.context.object.data
    moved = positions_of(mesh) + np.random.default_rng(0).normal(0, 0.02, (len(mesh.vertices), 3)).astype(np.float32)
    mesh.vertices.foreach_set("co", moved.reshape(-1))
    mesh.update()
    surface = Surface(*topology(mesh))
    assert surface.vertices.tolist() == list(range(len(mesh.vertices)))
    off = degrees(surface.normals(moved), blender_normals(mesh))
    assert off.max() < APPROXIMATE
    assert {tuple(edge) for edge in surface.edges.tolist()} == {tuple(sorted(edge.vertices)) for edge in mesh.edges}
    lengths = {edge.key: np.linalg.norm(moved[edge.vertices[0]] - moved[edge.vertices[1]]) for edge in mesh.edges}
    for edge, length in zip(surface.edges.tolist(), surface.edge_lengths(moved), strict=True):
        assert length == pytest.approx(lengths[tuple(edge)], rel=1e-5)


def test_faces_of_a_rig_are_those_of_its_mesh(rig):
    arrays = read_rig(rig)
    polygons = rig.mesh_object.data.polygons
    found = np.split(arrays.face_vertices, arrays.face_starts[1:])
    assert [face.tolist() for face in found] == [list(polygon.vertices) for polygon in polygons]


@pytest.fixture
def report(elbow_files, tmp_path) -> dict:
    path = tmp_path / "e.json"
    options = ["--poses", 24, "--seed", 3, "--action", "elbow_wave", "--range-scale", 2]
    assert run("evaluate", elbow_files.rig, elbow_files.model, "--json", path, *options) == 0
    return json.loads(path.read_text())


def test_the_model_shades_better_than_linear_skinning_everywhere_it_was_compared(report):
    for values in (report, *report["actions"], *report["scaled_ranges"]):
        normals, edges = values["normals"], values["edges"]
        assert list(normals) == list(edges) == ["fdda", "linear"]
        for way in ("fdda", "linear"):
            assert list(normals[way]) == ["mean", "p99", "max"] and list(edges[way]) == EDGES
            assert 0 < normals[way]["mean"] < normals[way]["p99"] <= normals[way]["max"] <= 180
        assert normals["fdda"]["mean"] < normals["linear"]["mean"]


def test_the_table_has_a_line_on_normals_and_one_on_edges(elbow_files, tmp_path, capfd):
    assert run("evaluate", elbow_files.rig, elbow_files.model, "--json", tmp_path / "e.json", "--poses", 3) == 0
    out, report = capfd.readouterr().out, json.loads((tmp_path / "e.json").read_text())
    fdda, linear = report["normals"]["fdda"], report["normals"]["linear"]
    assert f"FDDA {fdda['mean']:.3f}, p99 {fdda['p99']:.2f}; linear skinning {linear['mean']:.3f}, p99 " in out
    edges = report["edges"]["fdda"]
    percent = " / ".join(f"{100 * edges[kind]:.3f}" for kind in ("inside", "beside", "across"))
    assert f"FDDA {percent} ({edges['ratio']:.2f} times)" in out


def test_a_mesh_without_faces_has_no_normals(rig, tmp_path, capfd):
    mesh = bmesh.new()
    mesh.from_mesh(rig.mesh_object.data)
    bmesh.ops.delete(mesh, geom=mesh.faces[:], context="FACES_ONLY")
    mesh.to_mesh(rig.mesh_object.data)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "wire.blend"))
    model = tmp_path / "wire.onnx"
    assert run("record", tmp_path / "wire.blend", tmp_path / "recording", "--poses", 20) == 0
    train(tmp_path / "recording", model, "--passes", 2)
    assert run("evaluate", tmp_path / "wire.blend", model, "--json", tmp_path / "e.json", "--poses", 3) == 0
    report = json.loads((tmp_path / "e.json").read_text())
    assert report["normals"] is None and report["edges"] is None
    assert report["linear"]["mean"] > 0 and "normals" not in capfd.readouterr().out
