# SPDX-License-Identifier: GPL-3.0-or-later
"""The graph agrees with PyTorch for all transforms of bones, and has few nodes and constants."""

import json
from dataclasses import replace

import numpy as np
import onnx
import pytest

import trainer.train
from fdda_addon.core.errors import TrainingError
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.mathematics.skinning import LinearSkinning
from trainer.__main__ import main
from trainer.export import network_nodes
from trainer.export.export import build_graph, check_parity, measure, open_session, reference_positions
from trainer.model import TrainedModel

from ..recordings import read_skinned, write_recording
from .chain import chain_angles, chain_info, chain_residuals, chain_rig, constant_names, pose_chain, rotation
from .conftest import QUICK_OPTIONS

SHEAR = np.eye(4)
SHEAR[0, 1] = 0.3


def collect_trained_models(monkeypatch) -> list[TrainedModel]:
    """Return a list to which every later training adds its model."""
    trained_models, make_trained_model = [], trainer.train.make_trained_model
    monkeypatch.setattr(
        trainer.train,
        "make_trained_model",
        lambda *args: trained_models.append(make_trained_model(*args)) or trained_models[-1],
    )
    return trained_models


@pytest.fixture(scope="module")
def trained_model(recording, tmp_path_factory) -> TrainedModel:
    with pytest.MonkeyPatch.context() as monkeypatch:
        trained_models = collect_trained_models(monkeypatch)
        assert main([str(recording), str(tmp_path_factory.mktemp("graph") / "model.onnx"), *QUICK_OPTIONS]) == 0
    return trained_models[0]


def run_graph(trained_model: TrainedModel, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    session = open_session(build_graph(trained_model).SerializeToString())
    return tuple(session.run(["positions", "confidence"], {"pose_matrices": poses}))


def check_agreement(trained_model: TrainedModel, poses: np.ndarray, tolerance: float = 2e-6) -> np.ndarray:
    """Compare the graph with PyTorch, and return the confidence."""
    positions, confidence = run_graph(trained_model, poses)
    expected, expected_confidence = reference_positions(trained_model, poses, np.zeros((len(poses), 0), np.float32))
    np.testing.assert_allclose(positions, expected, atol=tolerance)
    np.testing.assert_allclose(confidence, expected_confidence, atol=1e-5)
    return confidence


def test_the_graph_agrees_with_pytorch_for_rigid_bones(trained_model):
    angles = chain_angles(20, 3, 5)
    angles[:, 2, 1] = 0
    assert (check_agreement(trained_model, pose_chain(trained_model.rig, angles)) == 1).all()


def test_a_character_that_is_scaled_as_a_whole_keeps_its_residuals(trained_model):
    angles = chain_angles(10, 3, 5)
    angles[:, 2, 1] = 0
    poses = pose_chain(trained_model.rig, angles)
    scaled_poses = np.diag([2, 2, 2, 1]).astype(np.float32) @ poses
    # The last partition does not depend on the root, which was locked.
    last_vertices = trained_model.partitions[2].vertices
    positions, confidence = run_graph(trained_model, scaled_poses)
    assert (confidence[:, 2] == 1).all()
    np.testing.assert_allclose(
        positions[:, last_vertices], 2 * run_graph(trained_model, poses)[0][:, last_vertices], atol=4e-6
    )
    assert np.abs(positions - LinearSkinning(trained_model.rig).positions(scaled_poses))[:, last_vertices].max() > 1e-3


FAR_AWAY = np.eye(4)
FAR_AWAY[:3, 3] = 60, -70, 40


@pytest.mark.parametrize(
    ("bone_change", "move", "tolerance"),
    [
        *((np.diag([*scale, 1]), np.eye(4), 2e-6) for scale in [(2, 2, 2), (0.01, 0.01, 0.01), (1.1, 0.9, 1.05)]),
        (SHEAR, np.eye(4), 2e-6),
        (np.eye(4), FAR_AWAY, 1e-4),
    ],
)
def test_the_graph_agrees_with_pytorch_for_other_bones(trained_model, bone_change, move, tolerance):
    poses = (move @ pose_chain(trained_model.rig, chain_angles(20, 3, 5)) @ bone_change).astype(np.float32)
    confidence = check_agreement(trained_model, poses, tolerance)
    assert (confidence >= 0).all() and (confidence <= 1).all()


def test_a_model_of_sheared_bones_agrees_with_pytorch(tmp_path):
    rig, angles = chain_rig(), chain_angles(120, 3, 0)
    # A mesh object that is scaled along a slanted axis shears every matrix.
    slanted_scale = rotation(0, 0.7) @ np.diag([1, 1, 0.6, 1]) @ rotation(0, -0.7)
    rig = replace(rig, rest_matrices=(slanted_scale @ rig.rest_matrices).astype(np.float32))
    poses = (slanted_scale @ pose_chain(chain_rig(), angles)).astype(np.float32)
    influencing = {0: (1,), 1: (1, 2), 2: (2,)}
    write_recording(
        tmp_path / "recording",
        rig,
        make_partitions(rig, influencing),
        chain_info(120),
        poses,
        chain_residuals(chain_rig(), angles),
    )
    assert main([str(tmp_path / "recording"), str(tmp_path / "model.onnx"), *QUICK_OPTIONS]) == 0
    assert read_model_info(tmp_path / "model.onnx").parity_mm < 1e-2
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["fdda"]["held_out"]["mean"] < 0.1 * report["linear"]["held_out"]["mean"]


def test_the_graph_has_few_nodes(trained):
    """The time of a frame grows with the number of nodes."""
    info, graph = read_model_info(trained / "model.onnx"), onnx.load(trained / "model.onnx").graph
    loaded = constant_names(graph)
    assert len([node for node in graph.node if node.output[0] not in loaded]) <= 69 + len(info.partitions)


@pytest.mark.parametrize("joints", [(0, 1, 2), (0, 1), (2,)])
def test_partial_slices_of_translations_agree_with_pytorch(trained_model, joints):
    """The fits of some partitions lose joints, so that slices of translations are only partly filled."""
    poses = pose_chain(trained_model.rig, chain_angles(5, 3, 3))
    prepared = list(trained_model.prepared)
    for index in joints:
        fit = prepared[index].fit
        is_main_joint = fit.joints == trained_model.partitions[index].joint
        factors = fit.factors.reshape(len(is_main_joint), -1)[is_main_joint].reshape(-1, fit.factors.shape[-1])
        prepared[index] = replace(prepared[index], fit=replace(fit, joints=fit.joints[is_main_joint], factors=factors))
    check_agreement(replace(trained_model, prepared=tuple(prepared)), poses)


@pytest.mark.parametrize("chunk_cost, split_cost", [(0, 0), (30, 0), (0, 10**9)])
def test_networks_in_chunks_have_the_same_outputs(trained_model, monkeypatch, chunk_cost, split_cost):
    """Depending on the costs, a chunk has one, several, or all inputs or components of a network."""
    poses = pose_chain(trained_model.rig, chain_angles(5, 3, 3))
    expected, _ = run_graph(trained_model, poses)
    monkeypatch.setattr(network_nodes, "CHUNK_COST", chunk_cost)
    monkeypatch.setattr(network_nodes, "SPLIT_COST", split_cost)
    np.testing.assert_allclose(run_graph(trained_model, poses)[0], expected, atol=2e-6)
    assert ("layer_sums" in {node.name for node in build_graph(trained_model).graph.node}) == (split_cost == 0)


def constant_bytes(model: onnx.ModelProto) -> int:
    """Return the bytes of the constants in memory, where compact ones are float32."""
    arrays = [onnx.numpy_helper.to_array(tensor) for tensor in model.graph.initializer]
    return sum(array.size * max(4, array.itemsize) for array in arrays)


def test_constants_are_the_matrices_and_little_else(trained, trained_model, report):
    info = read_model_info(trained / "model.onnx")
    assert info.constant_bytes == report["constant_bytes"] == constant_bytes(onnx.load(trained / "model.onnx"))
    assert f"{info.constant_bytes:,}" in (trained / "report.html").read_text()
    network_parameters = sum(a.size for p in trained_model.prepared for a in (*p.network.weights, *p.network.biases))
    matrix_elements = sum(
        (4 * 2 + 4 * len(p.fit.joints) + 3 * len(p.basis.components)) * p.vertex_count for p in trained_model.prepared
    )
    assert constant_bytes(build_graph(trained_model)) < 1.5 * 4 * (network_parameters + matrix_elements) + 16_000


class ShiftedSession:
    """A session whose positions are off by 0.1 mm."""

    def __init__(self, session):
        self._session = session

    def run(self, outputs, inputs):
        positions, *others = self._session.run(outputs, inputs)
        return positions + np.float32(1e-4), *others


def test_a_difference_from_pytorch_is_refused_unless_errors_or_residuals_are_far_larger(trained_model, recording):
    """A rig that bursts has errors of meters, and 16-bit integers round its residuals by tenths of a millimeter."""
    session = ShiftedSession(open_session(build_graph(trained_model).SerializeToString()))
    source = read_skinned(recording)
    held_out = measure(session, source, np.arange(5), trained_model)
    assert held_out.difference == pytest.approx(3**0.5 * 1e-4, rel=0.01)
    with pytest.raises(TrainingError, match=r"differs from PyTorch by 0\.17\d mm, more than the allowed .* bursts"):
        check_parity(source, replace(held_out, fdda=np.full((5, 1), 0.001)))
    check_parity(source, replace(held_out, fdda=np.full((5, 1), 0.1)))
    check_parity(source, replace(held_out, fdda=np.full((5, 1), 0.001), linear=np.full((5, 1), 0.5)))
