# SPDX-License-Identifier: GPL-3.0-or-later
"""Evaluations and benchmarks equal a direct computation, on poses that no recording contains; normals are Blender's."""

import json

import bmesh
import bpy
import numpy as np
import pytest

from fdda_addon.cli.evaluate import table
from fdda_addon.core.errors import RigError
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.mathematics.metrics import error_statistics
from fdda_addon.core.mathematics.poses import sample_pose, widen_ranges
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.mathematics.surface import Surface
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.evaluation.results import Evaluation, PoseErrors
from fdda_addon.evaluation.run import FIRST_HELD_OUT_INDEX, evaluate, evaluate_action
from fdda_addon.evaluation.settings import EvaluationSettings
from fdda_addon.poses.sampling import sampled_channels
from fdda_addon.rig.reading import read_rig
from fdda_addon.runtime.network import Network
from fdda_addon.scene.armature import Poser, clear_pose
from fdda_addon.scene.mesh import evaluated_positions, topology
from fdda_addon.timing.benchmark import MAX_ROUNDS

from ..conftest import run, train
from ..scene_state import drain

STATISTIC_NAMES = ["mean", "rms", "p99", "p999", "max"]


@pytest.fixture(scope="module")
def report(elbow_files, tmp_path_factory) -> dict:
    """Return the report of `evaluate --json` with an action and scaled ranges of motion."""
    path = tmp_path_factory.mktemp("evaluation") / "e.json"
    options = ["--poses", 12, "--seed", 3, "--action", "elbow_wave", "--range-scale", 1.5, "--range-scale", 2]
    assert run("evaluate", elbow_files.rig, elbow_files.model, "--json", path, *options) == 0
    return json.loads(path.read_text())


def test_the_table_says_where_the_model_is_farther_than_linear_skinning():
    arrays = np.zeros((2, 1, 4, 4), np.float32), np.zeros((2, 3, 3), np.float32), np.zeros((2, 0), np.float32)
    near, far = np.full((2, 3), 0.001, np.float32), np.full((2, 3), 0.002, np.float32)
    walk, run_errors = PoseErrors("walk", *arrays, fdda=far, linear=near), PoseErrors("run", *arrays, near, far)
    lines = table(Evaluation((), (), walk, [walk, run_errors])).splitlines()
    (index,) = (index for index, line in enumerate(lines) if "farther from the rig than linear skinning" in line)
    assert "2.0 instead of 1.0 mm on average" in lines[index]
    assert lines.index("walk, 2 poses") < index < lines.index("run, 2 poses")


def test_the_model_is_nearer_than_linear_skinning(report):
    assert 0 < report["fdda"]["mean"] < report["linear"]["mean"] / 3
    for values in (report["fdda"], report["linear"]):
        assert values["mean"] <= values["rms"] <= values["p999"] <= values["max"]
        assert values["p99"] <= values["p999"]


def compute_errors(rig, elbow_files, channels, seed: int, indices) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors (N, V) of model and linear skinning in meters, without the code for evaluation."""
    arrays = read_rig(rig)
    skinning, network = LinearSkinning(arrays), Network(elbow_files.model)
    bones, errors = rig.armature_object.pose.bones, ([], [])
    poser = Poser(rig, channels)
    for index in indices:
        poser.set(sample_pose(channels, seed, index))
        true_positions = evaluated_positions(rig.mesh_object, bpy.context.evaluated_depsgraph_get())
        to_mesh = rig.mesh_object.matrix_world.inverted() @ rig.armature_object.matrix_world
        pose = np.float32([[np.array(to_mesh @ bones[name].matrix) for name in arrays.joint_names]])
        for error_list, positions in zip(errors, (network.positions(pose), skinning.positions(pose)), strict=True):
            error_list.append(np.linalg.norm(positions[0] - true_positions, axis=1))
    return np.array(errors[0]), np.array(errors[1])


def test_errors_equal_a_direct_computation(report, rig, elbow_files):
    rig.armature_object.animation_data_clear()
    clear_pose(rig.armature_object)
    channels = sampled_channels(rig, read_rig(rig))
    fdda, linear = compute_errors(rig, elbow_files, channels, 3, range(FIRST_HELD_OUT_INDEX, FIRST_HELD_OUT_INDEX + 12))
    for errors, name in ((fdda, "fdda"), (linear, "linear")):
        assert report[name] == pytest.approx(error_statistics(errors).to_json(), abs=2e-4)
        mm = errors * 1000
        assert report[name]["mean"] == pytest.approx(mm.mean(), abs=2e-4)
        assert report[name]["max"] == pytest.approx(mm.max(), abs=2e-4)
    for partition, reported in zip(LinearSkinning(read_rig(rig)).partitions, report["partitions"], strict=True):
        assert reported["vertices"] == len(partition.vertices)
        assert reported["fdda"]["mean"] == pytest.approx(1000 * fdda[:, partition.vertices].mean(), abs=2e-4)
    assert widen_ranges(channels, 2)[0].high > channels[0].high


def evaluate_with_settings(rig, elbow_files, **settings) -> Evaluation:
    return drain(evaluate(rig, elbow_files.model, EvaluationSettings(**settings)))


def test_held_out_poses_are_not_in_the_recording(rig, elbow_files):
    """The evaluation uses the seed of the recording."""
    recording = read_recording(elbow_files.recording)
    evaluation = evaluate_with_settings(rig, elbow_files, poses=20, seed=recording.info.sampling.seed)
    for pose in evaluation.held_out.pose_matrices:
        assert np.abs(recording.pose_matrices - pose).max(axis=(1, 2, 3)).min() > 1e-3
    assert read_model_info(elbow_files.model).meshes[0].fingerprint == recording.rig.meshes[0].fingerprint


def test_the_seed_determines_the_held_out_poses(rig, elbow_files):
    first, second, other_seed = (evaluate_with_settings(rig, elbow_files, poses=4, seed=seed) for seed in (1, 1, 2))
    assert first.to_json() == second.to_json()
    assert np.abs(first.held_out.pose_matrices - other_seed.held_out.pose_matrices).max() > 1e-2


def test_frames_of_an_action_are_evaluated(rig, elbow_files):
    (errors,) = evaluate_with_settings(rig, elbow_files, poses=1, actions=("elbow_wave",)).actions
    for frame in (1, 10, 22):
        bpy.context.scene.frame_set(frame)
        true_positions = evaluated_positions(rig.mesh_object, bpy.context.evaluated_depsgraph_get())
        np.testing.assert_allclose(errors.positions[frame - 1], true_positions, atol=1e-6)


def test_a_bound_file_is_compared_with_its_rig(elbow_files, tmp_path):
    for name, file in (("rig", elbow_files.rig), ("bound", elbow_files.bound)):
        assert run("evaluate", file, elbow_files.model, "--json", tmp_path / name, "--poses", 3) == 0
    first, second = (json.loads((tmp_path / name).read_text()) for name in ("rig", "bound"))
    assert first == second and first["linear"]["mean"] > 0.1


def test_evaluate_prints_a_table_of_the_report(elbow_files, tmp_path, capfd):
    arguments = ["--json", tmp_path / "e.json", "--poses", 3, "--action", "elbow_wave"]
    assert run("evaluate", elbow_files.rig, elbow_files.model, *arguments) == 0
    captured = capfd.readouterr()
    report = json.loads((tmp_path / "e.json").read_text())
    for values in (report, report["actions"][0]):
        for method, label in (("linear", "linear skinning"), ("fdda", "FDDA")):
            row = "".join(f"{values[method][name]:>10.4f}" for name in STATISTIC_NAMES)
            assert f"  {label:<22}{row}" in captured.out
    assert "evaluation: 33 of 33, " in captured.err
    fdda, linear, edges = report["normals"]["fdda"], report["normals"]["linear"], report["edges"]["fdda"]
    line = f"FDDA {fdda['mean']:.3f}, p99 {fdda['p99']:.2f}; linear skinning {linear['mean']:.3f}, p99 "
    assert line in captured.out
    percent = " / ".join(f"{100 * edges[kind]:.3f}" for kind in ("inside", "beside", "across"))
    assert f"FDDA {percent} ({edges['ratio']:.2f} times)" in captured.out


def pixels(path) -> np.ndarray:
    """Return the pixels (height, width, 4) of a picture, float32."""
    image = bpy.data.images.load(str(path))
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)


def test_the_heat_map_shows_colored_errors(elbow_files, tmp_path):
    path = tmp_path / "heat.png"
    arguments = ["--json", tmp_path / "e.json", "--poses", 5, "--heatmap", path]
    assert run("evaluate", elbow_files.rig, elbow_files.model, *arguments) == 0
    # Text in a picture could reveal paths and names of the user's computer.
    assert not any(kind in path.read_bytes() for kind in (b"tEXt", b"zTXt", b"iTXt"))
    assert path.read_bytes().startswith(b"\x89PNG")
    picture = pixels(path)[..., :3]
    assert min(picture.shape[:2]) > 300
    # Vertices without an error are green. Linear skinning has errors of millimeters, in other colors.
    green = (picture[..., 1] > 1.5 * picture[..., 0]) & (picture[..., 1] > 1.5 * picture[..., 2])
    blue = picture[..., 2] > 1.3 * picture[..., 1]
    assert green.mean() > 0.02 and blue.mean() > 0.02
    assert len(np.unique((picture * 16).astype(int).reshape(-1, 3), axis=0)) > 30


def test_the_benchmark_reports_times_and_their_ratio(elbow_files, tmp_path):
    path = tmp_path / "b.json"
    assert run("benchmark", elbow_files.rig, elbow_files.model, "--json", path, "--frames", 12) == 0
    report = json.loads(path.read_text())
    methods = ["rig", "linear", "fdda", "without_meshes", "bones", "inference"]
    assert (report["unit"], report["vertices"]) == ("ms", 300)
    # At least five rounds of three frames; more while the times vary.
    assert report["frames"] in range(15, 3 * MAX_ROUNDS + 1, 3)
    assert report["blender"] == bpy.app.version_string
    for method in methods:
        assert min(report[method].values()) > 0
    assert report["linear"]["median"] < report["rig"]["median"]
    assert report["ratio"] == pytest.approx(report["rig"]["median"] / report["fdda"]["median"], rel=0.05)
    assert report["is_faster"] == (report["ratio"] > 1) and not report["is_estimate"]
    assert report["meshes"] == [{"name": "elbow", "vertices": 300, "has_model": True, "reason": ""}]


def test_an_action_has_the_same_errors_with_and_without_held_out_poses(rig, elbow_files):
    settings = EvaluationSettings(1, actions=("elbow_wave",))
    with_held_out = drain(evaluate(rig, elbow_files.model, settings)).actions[0]
    action_only = drain(evaluate_action(rig, Network(elbow_files.model), "elbow_wave"))
    assert action_only.held_out.name == "elbow_wave"
    np.testing.assert_allclose(action_only.held_out.fdda, with_held_out.fdda, atol=1e-6)
    assert sum(len(partition.vertices) for partition in action_only.partitions) == with_held_out.fdda.shape[1]
    with pytest.raises(RigError, match="no action 'jump'"):
        drain(evaluate_action(rig, elbow_files.model, "jump"))


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


def test_the_model_shades_better_than_linear_skinning_everywhere_it_was_compared(report):
    for values in (report, *report["actions"], *report["scaled_ranges"]):
        normals, edges = values["normals"], values["edges"]
        assert list(normals) == list(edges) == ["fdda", "linear"]
        for way in ("fdda", "linear"):
            assert list(normals[way]) == ["mean", "p99", "max"] and list(edges[way]) == EDGES
            assert 0 < normals[way]["mean"] < normals[way]["p99"] <= normals[way]["max"] <= 180
        assert normals["fdda"]["mean"] < normals["linear"]["mean"]


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
