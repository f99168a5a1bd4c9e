# SPDX-License-Identifier: GPL-3.0-or-later
"""ONNX models of three joints and four vertices, valid or damaged as a test needs them."""

import hashlib
from dataclasses import replace

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from fdda_addon.core.formats.model import CHECKSUM_KEY, METADATA_KEY
from fdda_addon.core.formats.model_info import ModelInfo, ModelPartition
from fdda_addon.core.rig import Fingerprint, Joint, MeshPart

JOINT_COUNT, VERTEX_COUNT = 3, 4


def tiny_info(**changes) -> ModelInfo:
    """Return metadata of the tiny model, with some changed fields."""
    rng = np.random.default_rng(0)
    info = ModelInfo(
        joints=(Joint("root", -1), Joint("upper.L", 0), Joint("löwer", 1)),
        rest_matrices=rng.normal(size=(JOINT_COUNT, 4, 4)).astype(np.float32),
        meshes=(MeshPart("mesh", VERTEX_COUNT, Fingerprint("a1", "b2", "c3")),),
        partitions=(ModelPartition(0, (), 1, 0), ModelPartition(2, (1, 2), 3, 17)),
        feature_low=rng.normal(size=(JOINT_COUNT, 12)).astype(np.float32),
        feature_high=rng.normal(size=(JOINT_COUNT, 12)).astype(np.float32),
        held_out_mm={"mean": 0.1, "rms": 0.2, "p99": 0.3, "p999": 0.4, "max": 0.5},
        parity_mm=0.00123,
        training={"seed": 5, "hidden": [128, 128]},
    )
    return replace(info, **changes)


def zeros_tensor(name: str = "zeros") -> TensorProto:
    """Return a constant of zeros with the shape of the positions of one pose."""
    return numpy_helper.from_array(np.zeros((1, VERTEX_COUNT, 3), np.float32), name)


def with_external_data(tensor: TensorProto, location: str = "weights.bin") -> TensorProto:
    """Change a tensor so that its data is in another file, and return it."""
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value=location)
    return tensor


def tiny_model(metadata: str | None = "", nodes=(), initializers=(), inputs=(), sparse=()) -> onnx.ModelProto:
    """Return a model that `read_model` accepts, with additional nodes, initializers and inputs."""
    # Each coordinate is the sum of all pose matrices, so the output depends on the input.
    graph = helper.make_graph(
        [
            helper.make_node("ReduceSum", ["pose_matrices", "axes"], ["sum"], keepdims=0),
            helper.make_node("Reshape", ["sum", "shape"], ["column"]),
            helper.make_node("Add", ["column", "zeros"], ["positions"]),
            *nodes,
        ],
        "deformation",
        [helper.make_tensor_value_info("pose_matrices", TensorProto.FLOAT, ["N", JOINT_COUNT, 4, 4]), *inputs],
        [helper.make_tensor_value_info("positions", TensorProto.FLOAT, ["N", VERTEX_COUNT, 3])],
        [
            numpy_helper.from_array(np.array([1, 2, 3], np.int64), "axes"),
            numpy_helper.from_array(np.array([-1, 1, 1], np.int64), "shape"),
            zeros_tensor(),
            *initializers,
        ],
        sparse_initializer=list(sparse),
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    model.metadata_props.add(key=CHECKSUM_KEY, value=hashlib.sha256(model.graph.SerializeToString()).hexdigest())
    if metadata is not None:
        model.metadata_props.add(key=METADATA_KEY, value=metadata or tiny_info().to_json())
    return model


def in_subgraph(node: onnx.NodeProto, depth: int = 1) -> onnx.NodeProto:
    """Nest a node `depth` levels deep in the branches of If nodes, and return the outermost node."""
    if depth == 0:
        return node
    output = helper.make_tensor_value_info("inner", TensorProto.FLOAT, None)
    branch = helper.make_graph([in_subgraph(node, depth - 1)], f"branch {depth}", [], [output])
    return helper.make_node("If", ["condition"], [f"if {depth}"], then_branch=branch, else_branch=branch)
