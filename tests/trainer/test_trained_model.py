# SPDX-License-Identifier: GPL-3.0-or-later
"""The exported model approximates the rig, fades to linear skinning outside the training range, and has metadata."""

import json

import numpy as np
import onnx
import onnxruntime
import pytest

from fdda_addon.core.formats.model import check_rig, read_model_info
from fdda_addon.core.mathematics.features import joint_features
from fdda_addon.core.mathematics.metrics import distances
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.rig import Rig
from trainer.__main__ import main

from ..recordings import read_skinned
from .chain import MAX_ANGLE, chain_angles, chain_residuals, pose_chain, write_chain


@pytest.fixture(scope="module")
def rig(recording) -> Rig:
    return read_skinned(recording).rig


@pytest.fixture(scope="module")
def session(trained) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(str(trained / "model.onnx"), providers=["CPUExecutionProvider"])


def run_model(session, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return tuple(session.run(["positions", "confidence"], {"pose_matrices": poses}))


def test_the_model_approximates_unseen_poses(session, rig):
    angles = chain_angles(50, 3, seed=99)
    angles[:, 2, 1] = 0
    poses = pose_chain(rig, angles)
    skinning = LinearSkinning(rig)
    truth = skinning.complex_positions(poses, chain_residuals(rig, angles))
    error, linear = distances(run_model(session, poses)[0], truth), distances(skinning.positions(poses), truth)
    assert linear.mean() > 2e-3
    assert error.mean() < 0.08 * linear.mean()


def test_the_poses_of_a_batch_of_any_size_are_independent(session, rig):
    poses = pose_chain(rig, chain_angles(7, 3, seed=5))
    batch_positions, confidence = run_model(session, poses)
    assert batch_positions.shape == (7, rig.vertex_count, 3) and batch_positions.dtype == np.float32
    assert confidence.shape == (7, len(partitions_in_metadata(session)))
    for index in (0, 6):
        single_positions = run_model(session, poses[index : index + 1])[0]
        np.testing.assert_allclose(single_positions[0], batch_positions[index], atol=2e-6)


def partitions_in_metadata(session) -> list:
    return json.loads(session.get_modelmeta().custom_metadata_map["fdda"])["partitions"]


def test_confidence_is_one_in_recorded_poses(session, recording):
    confidence = run_model(session, np.array(read_skinned(recording).pose_matrices))[1]
    assert (confidence == 1).all()


def test_confidence_fades_outside_the_range(session, rig):
    angles = np.zeros((40, 3, 2))
    angles[:, 1, 0] = np.linspace(MAX_ANGLE, MAX_ANGLE * 3, 40)
    confidence = run_model(session, pose_chain(rig, angles))[1]
    assert confidence[0].min() == 1
    assert (np.diff(confidence, axis=0) <= 1e-6).all(), "confidence must not increase with the distance"
    assert 0 < confidence[-1, :2].max() < 0.99
    assert np.abs(np.diff(confidence, axis=0)).max() < 0.05, "confidence must not jump"


def test_only_linear_skinning_remains_far_outside_the_range(session, rig, trained):
    poses = pose_chain(rig, np.zeros((3, 3, 2)))
    poses[:, 1:, :3, :3] *= np.float32([1, 5, 50])[:, None, None, None]
    positions, confidence = run_model(session, poses)
    assert (confidence[0] == 1).all() and (np.diff(confidence[:, :2], axis=0) <= 0).all()
    zero_confidence_partitions = np.flatnonzero(confidence[2] == 0)
    assert len(zero_confidence_partitions), "some partition must lose its confidence when joints are scaled by 50"
    partitions = read_model_info(trained / "model.onnx").partitions_of(rig)
    linear = LinearSkinning(rig).positions(poses)
    for index in zero_confidence_partitions:
        vertices = partitions[index].vertices
        np.testing.assert_allclose(positions[2, vertices], linear[2, vertices], atol=1e-4)


def test_a_locked_axis_that_rotates_lowers_the_confidence(session, rig):
    angles = np.zeros((3, 3, 2))
    angles[1:, 2, 1] = 0.5, 1.5
    confidence = run_model(session, pose_chain(rig, angles))[1]
    assert (confidence[0] == 1).all()
    assert 1 > confidence[1, 2] > confidence[2, 2], "the last joint never rotated about z in the recording"


@pytest.mark.parametrize("reach", [1.5, 2.0, 3.0])
def test_the_model_is_never_worse_than_linear_skinning_beyond_the_range(session, rig, reach):
    angles = chain_angles(100, 3, seed=8, range_scale=reach)
    poses, skinning = pose_chain(rig, angles), LinearSkinning(rig)
    truth = skinning.complex_positions(poses, chain_residuals(rig, angles))
    positions = run_model(session, poses)[0]
    assert distances(positions, truth).mean() <= distances(skinning.positions(poses), truth).mean()


def test_a_joint_scaled_to_zero_gives_finite_positions(session, rig):
    poses = pose_chain(rig, chain_angles(2, 3, seed=1))
    poses[1, 1, :3, :3] = 0
    positions, confidence = run_model(session, poses)
    assert np.isfinite(positions).all() and np.isfinite(confidence).all()
    assert confidence[1].min() < 1


def test_metadata_describes_rig_and_training(trained, recording, report):
    info, source_recording = read_model_info(trained / "model.onnx"), read_skinned(recording)
    check_rig(trained / "model.onnx", info, source_recording.rig)
    assert (info.joints, info.meshes) == (source_recording.rig.joints, source_recording.rig.meshes)
    assert [p.joint for p in info.partitions] == [p.joint for p in source_recording.partitions]
    assert [p.basis for p in info.partitions] == [p["basis"] for p in report["partitions"]]
    assert info.limits == source_recording.info.sampling.channels
    assert info.training["hidden"] == [24, 24] and info.training["seed"] == 0 and info.training["torch"]
    assert info.held_out_mm == report["fdda"]["held_out"]
    assert 0 < info.parity_mm < 1e-2
    features = joint_features(
        source_recording.pose_matrices, source_recording.rig.rest_matrices, source_recording.rig.parents
    )
    assert (info.feature_low <= features.min(axis=0)).mean() > 0.95
    assert info.feature_low.shape == info.feature_high.shape == (3, 12)


def test_the_graph_has_standard_operators_of_an_early_opset(trained):
    model = onnx.load(trained / "model.onnx")
    assert model.ir_version <= 9 and [(o.domain, o.version) for o in model.opset_import] == [("", 17)]
    assert {node.domain for node in model.graph.node} == {""}
    assert not any(t.external_data for t in model.graph.initializer)


def test_the_report_has_the_errors_of_the_model(report, trained, recording, session):
    source_recording = read_skinned(recording)
    assert sum(p["vertices"] for p in report["partitions"]) == source_recording.rig.vertex_count
    assert report["model_bytes"] == (trained / "model.onnx").stat().st_size
    held_out, linear = report["fdda"]["held_out"], report["linear"]["held_out"]
    assert held_out["mean"] < 0.1 * linear["mean"]
    assert held_out["mean"] <= held_out["rms"] <= held_out["p999"] <= held_out["max"]
    weights = [p["vertices"] for p in report["partitions"]]
    by_partition = np.average([p["held_out"]["mean"] for p in report["partitions"]], weights=weights)
    assert by_partition == pytest.approx(held_out["mean"], rel=1e-4)
    assert sum(report["histogram"]["fdda"]) == source_recording.rig.vertex_count * report["training"]["held_out_poses"]
    for p in report["partitions"]:
        assert len(p["curve"]["validation"]) == (40 if p["basis"] else 0)
    normals, edges = report["normals"], report["edges"]
    assert 0 < normals["fdda"]["mean"] < normals["linear"]["mean"] < normals["linear"]["p99"]
    assert edges["fdda"]["across"] < edges["linear"]["across"]


def test_a_rig_of_one_joint_is_exported(tmp_path):
    rig = write_chain(tmp_path / "one", pose_count=12, joint_count=1)
    model = tmp_path / "m.onnx"
    assert main([str(tmp_path / "one"), str(model), "--passes", "1"]) == 0
    session = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    positions, confidence = run_model(session, rig.rest_matrices[None])
    np.testing.assert_allclose(positions[0], rig.rest_positions, atol=1e-5)
    assert confidence.tolist() == [[1.0]]
