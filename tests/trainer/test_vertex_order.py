# SPDX-License-Identifier: GPL-3.0-or-later
"""The graph reorders vertices to mesh order for any partitions, and large meshes in blocks."""

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper

from trainer.export.skinning_nodes import VertexOrder, vertex_order
from trainer.graph_builder import GraphBuilder


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
