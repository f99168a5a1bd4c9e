# SPDX-License-Identifier: GPL-3.0-or-later
"""ONNX models of three joints and four vertices, as good or as bad as a test wants them."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from fdda_addon.core.model import CHECKSUM_KEY, METADATA_KEY, ModelInfo, ModelPartition
from fdda_addon.core.onnx_file import read_onnx
from fdda_addon.core.rig import Fingerprint, Joint

J, V = 3, 4


def tiny_info(**changes) -> ModelInfo:
    """Metadata with a different value in every place."""
    rng = np.random.default_rng(0)
    info = ModelInfo(
        joints=(Joint("root", -1), Joint("upper.L", 0), Joint("löwer", 1)),
        rest_matrices=rng.normal(size=(J, 4, 4)).astype(np.float32),
        vertex_count=V,
        fingerprint=Fingerprint("a1", "b2", "c3"),
        partitions=(ModelPartition(0, (), 1, 0), ModelPartition(2, (1, 2), 3, 17)),
        feature_low=rng.normal(size=(J, 12)).astype(np.float32),
        feature_high=rng.normal(size=(J, 12)).astype(np.float32),
        held_out_mm={"mean": 0.1, "rms": 0.2, "p99": 0.3, "p999": 0.4, "max": 0.5},
        parity_mm=0.00123,
        training={"seed": 5, "hidden": [128, 128]},
    )
    return replace(info, **changes)


def constant(name: str = "zeros") -> TensorProto:
    return numpy_helper.from_array(np.zeros((1, V, 3), np.float32), name)


def external(tensor: TensorProto, location: str = "weights.bin") -> TensorProto:
    """The tensor, its data in another file."""
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value=location)
    return tensor


def tiny_model(metadata: str | None = "", nodes=(), initializers=(), inputs=(), sparse=()) -> onnx.ModelProto:
    """A model that `read_model` takes, with more nodes, initializers and inputs.

    Args:
        metadata: text of the metadata property; `tiny_info` when empty, none when None.
    """
    # The first joint's first row, summed up, for every vertex: enough to have an output that depends on the input.
    graph = helper.make_graph(
        [
            helper.make_node("ReduceSum", ["pose_matrices", "axes"], ["sum"], keepdims=0),
            helper.make_node("Reshape", ["sum", "shape"], ["column"]),
            helper.make_node("Add", ["column", "zeros"], ["positions"]),
            *nodes,
        ],
        "deformation",
        [helper.make_tensor_value_info("pose_matrices", TensorProto.FLOAT, ["N", J, 4, 4]), *inputs],
        [helper.make_tensor_value_info("positions", TensorProto.FLOAT, ["N", V, 3])],
        [
            numpy_helper.from_array(np.array([1, 2, 3], np.int64), "axes"),
            numpy_helper.from_array(np.array([-1, 1, 1], np.int64), "shape"),
            constant(),
            *initializers,
        ],
        sparse_initializer=list(sparse),
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    # Some are refused before their checksum is compared.
    with suppress(ValueError):
        model.metadata_props.add(key=CHECKSUM_KEY, value=read_onnx(model.SerializeToString()).checksum)
    if metadata is not None:
        model.metadata_props.add(key=METADATA_KEY, value=metadata or tiny_info().to_json())
    return model


def in_subgraph(node: onnx.NodeProto, depth: int = 1) -> onnx.NodeProto:
    """An If node whose branches hold the node, `depth` levels down."""
    if depth == 0:
        return node
    output = helper.make_tensor_value_info("inner", TensorProto.FLOAT, None)
    branch = helper.make_graph([in_subgraph(node, depth - 1)], f"branch {depth}", [], [output])
    return helper.make_node("If", ["condition"], [f"if {depth}"], then_branch=branch, else_branch=branch)
