# SPDX-License-Identifier: GPL-3.0-or-later
"""The graph: it agrees with PyTorch wherever bones may be, costs no more than it must, and old models still play."""

import json
from dataclasses import replace

import numpy as np
import onnx
import pytest

import trainer.training
from fdda_addon.core.model import read_model_info
from fdda_addon.core.partition import make_partitions
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.core.skinning import LinearSkinning
from trainer import network_nodes, playback_nodes
from trainer.__main__ import main
from trainer.deformation import Deformation, is_sheared
from trainer.export import open_session, reference_positions
from trainer.graph import build_graph

from .chain import chain_angles, chain_info, chain_residuals, chain_rig, pose_chain, rotation
from .conftest import QUICK

SHEAR = np.eye(4)
SHEAR[0, 1] = 0.3


def keep_deformation(monkeypatch) -> list[Deformation]:
    """The deformations that trainings make from now on."""
    made, make = [], trainer.training._deformation
    monkeypatch.setattr(trainer.training, "_deformation", lambda *args: made.append(make(*args)) or made[-1])
    return made


@pytest.fixture(scope="module")
def deformation(recording, tmp_path_factory) -> Deformation:
    with pytest.MonkeyPatch.context() as monkeypatch:
        made = keep_deformation(monkeypatch)
        assert main([str(recording), str(tmp_path_factory.mktemp("graph") / "model.onnx"), *QUICK]) == 0
    return made[0]


def played(deformation: Deformation, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    session = open_session(build_graph(deformation).SerializeToString())
    return tuple(session.run(["positions", "confidence"], {"pose_matrices": poses}))


def agrees(deformation: Deformation, poses: np.ndarray, tolerance: float = 2e-6) -> np.ndarray:
    """Compare with PyTorch; returns the confidence."""
    positions, confidence = played(deformation, poses)
    expected, expected_confidence = reference_positions(deformation, poses, np.zeros((len(poses), 0), np.float32))
    np.testing.assert_allclose(positions, expected, atol=tolerance)
    np.testing.assert_allclose(confidence, expected_confidence, atol=1e-5)
    return confidence


@pytest.mark.parametrize("sheared", [False, True])
def test_rigid_bones(deformation, sheared):
    angles = chain_angles(20, 3, 5)
    angles[:, 2, 1] = 0
    assert (agrees(replace(deformation, sheared=sheared), pose_chain(deformation.rig, angles)) == 1).all()


@pytest.mark.parametrize("sheared", [False, True])
@pytest.mark.parametrize("scale", [(2, 2, 2), (0.01, 0.01, 0.01), (1.1, 0.9, 1.05)])
def test_scaled_bones(deformation, sheared, scale):
    poses = pose_chain(deformation.rig, chain_angles(20, 3, 5))
    poses[:, 1:] = poses[:, 1:] @ np.diag([*scale, 1]).astype(np.float32)
    agrees(replace(deformation, sheared=sheared), poses)


def test_a_character_that_is_scaled_as_a_whole_keeps_its_residuals(deformation):
    angles = chain_angles(10, 3, 5)
    angles[:, 2, 1] = 0
    poses = pose_chain(deformation.rig, angles)
    scaled = np.diag([2, 2, 2, 1]).astype(np.float32) @ poses
    # The last partition does not look at the root, which was locked.
    last = deformation.partitions[2].vertices
    positions, confidence = played(deformation, scaled)
    assert (confidence[:, 2] == 1).all()
    np.testing.assert_allclose(positions[:, last], 2 * played(deformation, poses)[0][:, last], atol=4e-6)
    assert np.abs(positions - LinearSkinning(deformation.rig).positions(scaled))[:, last].max() > 1e-3


def test_far_from_the_origin(deformation):
    poses = pose_chain(deformation.rig, chain_angles(5, 3, 5))
    away = np.eye(4)
    away[:3, 3] = 60, -70, 40
    agrees(deformation, (away @ poses).astype(np.float32), tolerance=1e-4)


def test_a_sheared_bone_gives_numbers_and_takes_trust_at_most(deformation):
    poses = (pose_chain(deformation.rig, chain_angles(5, 3, 5)).astype(np.float64) @ SHEAR).astype(np.float32)
    positions, confidence = played(deformation, poses)
    linear = LinearSkinning(deformation.rig).positions(poses)
    assert np.isfinite(positions).all() and (confidence >= 0).all() and (confidence <= 1).all()
    assert np.abs(positions - linear).max() < 0.1
    agrees(replace(deformation, sheared=True), poses)


def test_shear_is_found_and_scale_is_none(recording):
    poses = pose_chain(chain_rig(), chain_angles(300, 3, 0))
    assert not is_sheared(poses)
    assert not is_sheared(poses @ np.diag([3, 0.2, 1, 1]).astype(np.float32))
    poses[299, 1] = poses[299, 1] @ SHEAR.astype(np.float32)
    assert is_sheared(poses)
    # As little as a control rig makes of a bone that stretches.
    little = np.eye(4)
    little[0, 1] = 3e-5
    assert is_sheared((pose_chain(chain_rig(), chain_angles(20, 3, 0)) @ little).astype(np.float32))


def test_a_recording_with_sheared_bones_plays_them(tmp_path, monkeypatch):
    rig, angles = chain_rig(), chain_angles(120, 3, 0)
    # A mesh object that is scaled along a slanted axis shears every matrix.
    squash = rotation(0, 0.7) @ np.diag([1, 1, 0.6, 1]) @ rotation(0, -0.7)
    rig = replace(rig, rest_matrices=(squash @ rig.rest_matrices).astype(np.float32))
    poses = (squash @ pose_chain(chain_rig(), angles)).astype(np.float32)
    influencing = {0: (1,), 1: (1, 2), 2: (2,)}
    with RecordingWriter(tmp_path / "recording", rig, make_partitions(rig, influencing), chain_info(120)) as writer:
        writer.append(poses, chain_residuals(chain_rig(), angles))
    made = keep_deformation(monkeypatch)
    assert main([str(tmp_path / "recording"), str(tmp_path / "model.onnx"), *QUICK]) == 0
    assert made[0].sheared and read_model_info(tmp_path / "model.onnx").parity_mm < 1e-2
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["fdda"]["held_out"]["mean"] < 0.1 * report["linear"]["held_out"]["mean"]


def test_the_graph_has_few_nodes(trained):
    """A third of a microsecond each, and nearly one in a frame."""
    info, graph = read_model_info(trained / "model.onnx"), onnx.load(trained / "model.onnx").graph
    assert len(graph.node) <= 50 + len(info.partitions)


def product_count(deformation: Deformation) -> int:
    return sum(constant.name.startswith("matrix_") for constant in build_graph(deformation).graph.initializer)


def test_small_partitions_share_a_product(deformation, monkeypatch):
    poses = pose_chain(chain_rig(), chain_angles(5, 3, 3))
    together, _ = played(deformation, poses)
    assert product_count(deformation) == 1
    monkeypatch.setattr(playback_nodes, "PADDING_FLOATS", 0)
    apart, _ = played(deformation, poses)
    assert product_count(deformation) == len(deformation.partitions) == 3
    np.testing.assert_allclose(together, apart, atol=2e-6)


def test_only_small_partitions_share_a_product():
    small, large = (20, 40), (90, 3000)
    assert playback_nodes._products([large, small, small, large, small]) == [[1, 2, 4], [0], [3]]
    # With every one that joins, more zeros stand beside it.
    assert [len(product) for product in playback_nodes._products([small] * 12)] == [4, 4, 4]


def test_joints_are_moved_by_threes():
    def rows(joints: int) -> playback_nodes._Rows:
        return playback_nodes._Rows(shapes=2, turns=(), joints=tuple(range(joints)), skinning=1)

    for counts in ([4], [3, 6], [4, 5, 2, 2, 7], [2, 2, 2]):
        by_threes = playback_nodes._by_threes([rows(count) for count in counts])
        assert by_threes[0].early == 0 and all(own.spare == 0 for own in by_threes[:-1])
        assert by_threes[-1].spare == -sum(counts) % 3
        assert [own.size for own in by_threes] == [6 + 4 * own for own in counts[:-1]] + [
            6 + 4 * counts[-1] + by_threes[-1].spare
        ]
    # The next one's first rows are gathered with the last ones: it needs to have as many.
    assert [(own.early, own.spare) for own in playback_nodes._by_threes([rows(4), rows(1), rows(4)])] == [
        (0, 2),
        (0, 0),
        (2, 1),
    ]


@pytest.mark.parametrize("joints", [(0, 1, 2), (0, 1), (2,)])
def test_partitions_that_end_within_three_joints_play(deformation, joints):
    """Fitted to fewer joints, the last rows of a partition lie elsewhere."""
    poses = pose_chain(deformation.rig, chain_angles(5, 3, 3))
    prepared = list(deformation.prepared)
    for n in joints:
        fit = prepared[n].fit
        kept = fit.joints == deformation.partitions[n].joint
        factors = fit.factors.reshape(len(kept), -1)[kept].reshape(-1, fit.factors.shape[-1])
        prepared[n] = replace(prepared[n], fit=replace(fit, joints=fit.joints[kept], factors=factors))
    agrees(replace(deformation, prepared=tuple(prepared)), poses)


@pytest.mark.parametrize("piece, cut", [(0, 0), (100, 0), (0, 10**9)])
def test_networks_in_pieces_say_the_same(deformation, monkeypatch, piece, cut):
    """Pieces of one input and one shape, some of several, and one for each network."""
    poses = pose_chain(deformation.rig, chain_angles(5, 3, 3))
    expected, _ = played(deformation, poses)
    monkeypatch.setattr(network_nodes, "PIECE_FLOATS", piece)
    monkeypatch.setattr(network_nodes, "CUT_FLOATS", cut)
    np.testing.assert_allclose(played(deformation, poses)[0], expected, atol=2e-6)
    assert ("layer_sums" in {node.name for node in build_graph(deformation).graph.node}) == (cut == 0)


def test_pieces_are_as_large_as_costs_least():
    # One network sees a hundred times as much as nine others: not all are padded to it.
    assert 30 <= network_nodes._piece_size([3000, *[30] * 9], 192, 10) <= 60
    assert network_nodes._piece_size([30, 29, 28, 30], 192, 4) == 30
    assert network_nodes._pieces([5, 2], 2) == [(0, slice(0, 2)), (0, slice(2, 4)), (0, slice(4, 6)), (1, slice(0, 2))]


def constant_bytes(model: onnx.ModelProto) -> int:
    return sum(onnx.numpy_helper.to_array(tensor).nbytes for tensor in model.graph.initializer)


def test_constants_are_the_matrices_and_little_else(trained, deformation, report, monkeypatch):
    info = read_model_info(trained / "model.onnx")
    assert info.constant_bytes == report["constant_bytes"] == constant_bytes(onnx.load(trained / "model.onnx"))
    assert f"{info.constant_bytes:,}" in (trained / "report.html").read_text()
    networks = sum(a.size for network in deformation.networks for a in (*network.weights, *network.biases))
    matrices = sum((4 * 2 + 4 * len(p.fit.joints) + 3 * len(p.basis.shapes)) * p.vertices for p in deformation.prepared)
    together = constant_bytes(build_graph(deformation))
    monkeypatch.setattr(playback_nodes, "PADDING_FLOATS", 0)
    apart = constant_bytes(build_graph(deformation))
    assert apart < 1.5 * 4 * (networks + matrices) + 16_000
    # Zeros beside the second matrix and beside the third.
    assert apart < together < apart + 2 * 4 * 6_000
