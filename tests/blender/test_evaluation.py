# SPDX-License-Identifier: GPL-3.0-or-later
"""Evaluation and benchmark: the figures are what a direct computation gives, on poses that no recording has."""

import json

import bpy
import numpy as np
import pytest

from fdda_addon.core.errors import RigError
from fdda_addon.core.metrics import error_statistics
from fdda_addon.core.model import read_model_info
from fdda_addon.core.poses import sample_pose, widen_ranges
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.skinning import LinearSkinning
from fdda_addon.evaluation.run import (
    FIRST_HELD_OUT_INDEX,
    Evaluation,
    EvaluationSettings,
    NamedPose,
    evaluate,
    evaluate_action,
)
from fdda_addon.poses.sampling import sampled_channels
from fdda_addon.rig.reading import read_rig
from fdda_addon.runtime.network import Network
from fdda_addon.scene.armature import Poser, clear_pose
from fdda_addon.scene.mesh import evaluated_positions

from .conftest import run
from .scene_state import drain

STATISTICS = ["mean", "rms", "p99", "p999", "max"]


@pytest.fixture(scope="module")
def report(elbow, tmp_path_factory) -> dict:
    """What `evaluate --json` writes, with everything it can compare."""
    path = tmp_path_factory.mktemp("evaluation") / "e.json"
    options = ["--poses", 12, "--seed", 3, "--action", "elbow_wave", "--range-scale", 1.5, "--range-scale", 2]
    assert run("evaluate", elbow.rig, elbow.model, "--json", path, *options) == 0
    return json.loads(path.read_text())


def test_keys(report):
    assert list(report) == [
        *("unit", "poses", "vertices", "fdda", "linear", "partitions"),
        *("actions", "scaled_ranges", "named", "normals", "edges"),
    ]
    assert (report["unit"], report["poses"], report["vertices"]) == ("mm", 12, 300)
    assert list(report["fdda"]) == list(report["linear"]) == STATISTICS
    for partition in report["partitions"]:
        assert list(partition) == ["joint", "vertices", "fdda", "linear"]
        assert list(partition["fdda"]) == list(partition["linear"]) == STATISTICS
    assert [p["joint"] for p in report["partitions"]] == ["upper", "lower"]
    assert sum(p["vertices"] for p in report["partitions"]) == 300
    assert [(e["name"], e["poses"]) for e in report["actions"]] == [("elbow_wave", 30)]
    assert [(e["name"], e["poses"]) for e in report["scaled_ranges"]] == [
        ("1.5 times the range", 3),
        ("2 times the range", 3),
    ]
    assert report["named"] == []


def test_the_model_is_nearer_than_linear_skinning(report):
    assert 0 < report["fdda"]["mean"] < report["linear"]["mean"] / 3
    for values in (report["fdda"], report["linear"]):
        assert values["mean"] <= values["rms"] <= values["p999"] <= values["max"]
        assert values["p99"] <= values["p999"]


def by_hand(rig, elbow, channels, seed: int, indices) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N, V) of model and linear skinning, computed without the evaluation: meters."""
    arrays = read_rig(rig)
    skinning, network = LinearSkinning(arrays), Network(elbow.model)
    bones, errors = rig.armature_object.pose.bones, ([], [])
    poser = Poser(rig, channels)
    for index in indices:
        poser.set(sample_pose(channels, seed, index))
        true = evaluated_positions(rig.mesh_object, bpy.context.evaluated_depsgraph_get())
        to_mesh = rig.mesh_object.matrix_world.inverted() @ rig.armature_object.matrix_world
        pose = np.float32([[np.array(to_mesh @ bones[name].matrix) for name in arrays.joint_names]])
        for found, positions in zip(errors, (network.positions(pose), skinning.positions(pose)), strict=True):
            found.append(np.linalg.norm(positions[0] - true, axis=1))
    return np.array(errors[0]), np.array(errors[1])


def test_figures_are_what_a_direct_computation_gives(report, rig, elbow):
    rig.armature_object.animation_data_clear()
    clear_pose(rig.armature_object)
    channels = sampled_channels(rig, read_rig(rig))
    fdda, linear = by_hand(rig, elbow, channels, 3, range(FIRST_HELD_OUT_INDEX, FIRST_HELD_OUT_INDEX + 12))
    for errors, name in ((fdda, "fdda"), (linear, "linear")):
        assert report[name] == pytest.approx(error_statistics(errors).to_json(), abs=2e-4)
        mm = errors * 1000
        assert report[name]["mean"] == pytest.approx(mm.mean(), abs=2e-4)
        assert report[name]["max"] == pytest.approx(mm.max(), abs=2e-4)
    for partition, found in zip(LinearSkinning(read_rig(rig)).partitions, report["partitions"], strict=True):
        assert found["vertices"] == len(partition.vertices)
        assert found["fdda"]["mean"] == pytest.approx(1000 * fdda[:, partition.vertices].mean(), abs=2e-4)
    assert widen_ranges(channels, 2)[0].high > channels[0].high


def evaluated_with(rig, elbow, **settings) -> Evaluation:
    return drain(evaluate(rig, elbow.model, EvaluationSettings(**settings)))


def test_held_out_poses_are_no_poses_of_the_recording(rig, elbow):
    """Also with the seed of the recording."""
    recording = read_recording(elbow.recording)
    evaluation = evaluated_with(rig, elbow, poses=20, seed=recording.info.sampling.seed)
    for pose in evaluation.held_out.pose_matrices:
        assert np.abs(recording.pose_matrices - pose).max(axis=(1, 2, 3)).min() > 1e-3
    assert read_model_info(elbow.model).fingerprint == recording.rig.fingerprint


def test_same_seed_same_figures_other_seed_others(rig, elbow):
    first, second, other = (evaluated_with(rig, elbow, poses=4, seed=seed) for seed in (1, 1, 2))
    assert first.to_json() == second.to_json()
    assert np.abs(first.held_out.pose_matrices - other.held_out.pose_matrices).max() > 1e-2


def test_named_poses(rig, elbow):
    pose = NamedPose("fold", {"lower": (1.5, 0, 0), "upper": (0, 0.2, 0)})
    (errors,) = evaluated_with(rig, elbow, poses=1, named=(pose,)).named
    assert errors.name == "fold" and errors.fdda.shape == (1, 300)
    rig.armature_object.animation_data_clear()
    clear_pose(rig.armature_object)
    bones = rig.armature_object.pose.bones
    bones["lower"].rotation_euler, bones["upper"].rotation_euler = (1.5, 0, 0), (0, 0.2, 0)
    true = evaluated_positions(rig.mesh_object, bpy.context.evaluated_depsgraph_get())
    np.testing.assert_allclose(errors.positions[0], true, atol=1e-6)


def test_action_frames(rig, elbow):
    (errors,) = evaluated_with(rig, elbow, poses=1, actions=("elbow_wave",)).actions
    for frame in (1, 10, 22):
        bpy.context.scene.frame_set(frame)
        true = evaluated_positions(rig.mesh_object, bpy.context.evaluated_depsgraph_get())
        np.testing.assert_allclose(errors.positions[frame - 1], true, atol=1e-6)


def test_a_bound_file_is_evaluated_by_its_rig(elbow, tmp_path):
    for name, file in (("rig", elbow.rig), ("bound", elbow.bound)):
        assert run("evaluate", file, elbow.model, "--json", tmp_path / name, "--poses", 3) == 0
    first, second = (json.loads((tmp_path / name).read_text()) for name in ("rig", "bound"))
    assert first == second and first["linear"]["mean"] > 0.1


def test_the_table(elbow, tmp_path, capfd):
    arguments = ["--json", tmp_path / "e.json", "--poses", 3, "--action", "elbow_wave"]
    assert run("evaluate", elbow.rig, elbow.model, *arguments) == 0
    captured = capfd.readouterr()
    report = json.loads((tmp_path / "e.json").read_text())
    for values in (report, report["actions"][0]):
        for way, label in (("linear", "linear skinning"), ("fdda", "FDDA")):
            row = "".join(f"{values[way][name]:>10.4f}" for name in STATISTICS)
            assert f"  {label:<22}{row}" in captured.out
    assert "evaluation: 33 of 33, " in captured.err


def pixels(path) -> np.ndarray:
    """(height, width, 4) float32 of a picture."""
    image = bpy.data.images.load(str(path))
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)


def test_heat_map(elbow, tmp_path):
    path = tmp_path / "heat.png"
    arguments = ["--json", tmp_path / "e.json", "--poses", 5, "--heatmap", path]
    assert run("evaluate", elbow.rig, elbow.model, *arguments) == 0
    # Text in a picture would be the path and the machine of whoever made it.
    assert not any(kind in path.read_bytes() for kind in (b"tEXt", b"zTXt", b"iTXt"))
    assert path.read_bytes().startswith(b"\x89PNG")
    picture = pixels(path)[..., :3]
    assert min(picture.shape[:2]) > 300
    # Green where there is no error, and colors of the scale that are not: linear skinning is off by millimeters.
    green = (picture[..., 1] > 1.5 * picture[..., 0]) & (picture[..., 1] > 1.5 * picture[..., 2])
    blue = picture[..., 2] > 1.3 * picture[..., 1]
    assert green.mean() > 0.02 and blue.mean() > 0.02
    assert len(np.unique((picture * 16).astype(int).reshape(-1, 3), axis=0)) > 30


def test_benchmark(elbow, tmp_path, capfd):
    path = tmp_path / "b.json"
    assert run("benchmark", elbow.rig, elbow.model, "--json", path, "--frames", 12) == 0
    report = json.loads(path.read_text())
    methods = ["rig", "linear", "fdda", "floor", "inference"]
    assert list(report) == [
        "unit",
        "vertices",
        "frames",
        "blender",
        "processor",
        "cores",
        *methods,
        "ratio",
        "is_faster",
        "constant_bytes",
    ]
    assert (report["unit"], report["vertices"], report["frames"]) == ("ms", 300, 15)
    assert report["blender"] == bpy.app.version_string
    for method in methods:
        assert 0 < report[method]["median"] <= report[method]["p90"]
    assert report["linear"]["median"] < report["rig"]["median"]
    assert report["ratio"] == pytest.approx(report["rig"]["median"] / report["fdda"]["median"], rel=0.05)
    out = capfd.readouterr().out
    assert report["is_faster"] == (report["ratio"] > 1) == ("x faster than the rig." in out)
    assert report["is_faster"] != ("Not worth it here" in out)
    assert report["constant_bytes"] == Network(elbow.model).info.constant_bytes > 10_000
    assert f"{report['constant_bytes'] / 1e6:.2f}" in out


def test_an_action_alone_is_what_it_is_beside_held_out_poses(rig, elbow):
    settings = EvaluationSettings(1, actions=("elbow_wave",))
    beside = drain(evaluate(rig, elbow.model, settings)).actions[0]
    alone = drain(evaluate_action(rig, Network(elbow.model), "elbow_wave"))
    assert alone.held_out.name == "elbow_wave"
    np.testing.assert_allclose(alone.held_out.fdda, beside.fdda, atol=1e-6)
    assert sum(len(partition.vertices) for partition in alone.partitions) == beside.fdda.shape[1]
    with pytest.raises(RigError, match="no action 'jump'"):
        drain(evaluate_action(rig, elbow.model, "jump"))
