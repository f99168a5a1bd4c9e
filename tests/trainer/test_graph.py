# SPDX-License-Identifier: GPL-3.0-or-later
"""The graph agrees with PyTorch for all transforms, has few nodes and constants, and passes the add-on's checks."""

import json
import math
from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper

from fdda_addon.core.errors import ModelError, TrainingError
from fdda_addon.core.formats.model import check_model, read_model_info
from fdda_addon.core.formats.onnx_file import FREE_ELEMENTS, infer_shapes, read_onnx
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.mathematics.skinning import LinearSkinning
from trainer.__main__ import main
from trainer.config import ACTIVATION
from trainer.export import network_nodes
from trainer.export.export import build_graph, check_parity, measure, open_session, reference_positions
from trainer.export.skinning_nodes import VertexOrder, vertex_order
from trainer.graph_builder import GraphBuilder
from trainer.model import TrainedModel

from ..recordings import read_skinned, write_recording
from .chain import (
    chain_angles,
    chain_info,
    chain_residuals,
    chain_rig,
    constant_names,
    pose_chain,
    rotation,
    write_chain,
)
from .conftest import QUICK_OPTIONS

SHEAR = np.eye(4)

SHEAR[0, 1] = 0.3


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


def test_constants_are_the_matrices_and_little_else(trained_model):
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


def assign_strips(vertex_count: int, strip_length: int, partition_count: int) -> list[np.ndarray]:
    """Assign strips of adjacent vertices to partitions in rotation."""
    partition_by_vertex = np.arange(vertex_count) // strip_length % partition_count
    return [np.flatnonzero(partition_by_vertex == index) for index in range(partition_count)]


def run_order_graph(order: VertexOrder, pose_count: int) -> np.ndarray:
    """Return the (poses, V, 3) output of the graph for positions that encode their vertex and pose."""
    graph, columns = GraphBuilder(), np.concatenate(order.columns)
    order.add(graph, "joined", "positions")
    inputs = [helper.make_tensor_value_info("joined", TensorProto.FLOAT, ["N", len(columns), 3])]
    outputs = [helper.make_tensor_value_info("positions", TensorProto.FLOAT, ["N", order.vertex_count, 3])]
    proto = helper.make_graph(graph.nodes, "order", inputs, outputs, graph.constants)
    model = helper.make_model(proto, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    ordered_positions = columns[None, :, None] + np.arange(3) * 0.25 + 100_000 * np.arange(pose_count)[:, None, None]
    return session.run(None, {"joined": ordered_positions.astype(np.float32)})[0]


@pytest.mark.parametrize(
    ("vertices", "strip", "partitions"),
    [(5, 1, 2), (90, 7, 3), (9_960, 61, 22), (50_001, 500, 7), (40_000, 40_000, 1), (20_000, 1, 9), (32_768, 64, 4)],
)
def test_vertices_are_in_mesh_order(vertices, strip, partitions):
    order = vertex_order(assign_strips(vertices, strip, partitions))
    expected = np.arange(vertices)[:, None] + np.arange(3) * 0.25
    for pose, positions in enumerate(run_order_graph(order, 2)):
        np.testing.assert_array_equal(positions, (expected + 100_000 * pose).astype(np.float32))


def test_every_vertex_has_one_column():
    order = vertex_order(assign_strips(50_001, 500, 7))
    columns = np.concatenate(order.columns)
    np.testing.assert_array_equal(np.sort(columns[columns >= 0]), np.arange(50_001))
    assert (columns < 0).sum() < 7 * order.block_size


@pytest.mark.parametrize(("strip", "uses_blocks"), [(500, True), (1, False), (100_000, True)])
def test_blocks_are_used_only_for_long_strips(strip, uses_blocks):
    assert (vertex_order(assign_strips(50_000, strip, 5)).block_size > 1) == uses_blocks


def test_few_vertices_are_gathered_one_by_one():
    assert vertex_order(assign_strips(300, 30, 3)).block_size == 1


@pytest.fixture(scope="module")
def models(recording, tmp_path_factory) -> list[bytes]:
    """Models with each activation, with one and many joints, with deep and wide networks, and without components."""
    folder = tmp_path_factory.mktemp("models")
    for joints in (1, 12):
        write_chain(folder / f"chain_{joints}", pose_count=60, joint_count=joints)
    trainings = [(recording, "--activation", name, "--hidden", "24", "24") for name in ACTIVATION.choices]
    trainings += [(folder / f"chain_{joints}", "--hidden", "16") for joints in (1, 12)]
    trainings += [(recording, "--hidden", "300", "200", "100", "50"), (recording, "--detail-mm", "10000")]
    contents = []
    for index, (path, *options) in enumerate(trainings):
        model = folder / f"{index}.onnx"
        assert main([str(path), str(model), "--passes", "5", *options]) == 0
        contents.append(model.read_bytes())
    return contents


def test_the_add_on_accepts_every_exported_model_with_a_margin(models):
    """If the values of exported graphs come near the limit, it must be raised before it refuses a character."""
    operators = {node.op_type for data in models for node in onnx.load_from_string(data).graph.node}
    assert {"MatMul", "Gather", "Erf", "Tanh", "Relu", "Sigmoid"} <= operators
    for data in models:
        check_model(data, "m.onnx")
        contents = read_onnx(data)
        shapes = infer_shapes(contents, {name: (1, *shape[1:]) for name, shape in contents.inputs.items()}, 1)
        loaded = constant_names(onnx.load_from_string(data).graph)
        once = sum(math.prod(shapes[name]) for name in loaded - contents.constants.keys())
        per_pose = sum(math.prod(shape) for name, shape in shapes.items() if name not in loaded)
        assert max(once / 3, per_pose) < (len(data) + FREE_ELEMENTS) / 4


def test_changed_weights_are_refused(trained):
    data = bytearray((trained / "model.onnx").read_bytes())
    largest_constant = max(read_onnx(bytes(data)).constants.values(), key=lambda constant: len(constant.data)).data
    data[bytes(data).index(bytes(largest_constant)) + len(largest_constant) // 2] ^= 1
    with pytest.raises(ModelError, match="is damaged: its checksum is not that of its weights"):
        check_model(bytes(data), "m.onnx")
