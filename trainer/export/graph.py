# SPDX-License-Identifier: GPL-3.0-or-later
"""The model's ONNX graph: from pose matrices and controls to positions and confidence, in standard operators.

In each frame of an animation the graph evaluates one pose. Each node then takes nearly a microsecond, even if it
computes little, and all constants are read once. So the graph has few nodes and little padding, and multiplies by
matrices of ones and zeros in place of gathering. docs/experiments.md has the measurements.

Dimensions in the modules of the graph: N poses, J joints, C controls, F features, D surface frames, P partitions,
K components, V vertices.
"""

import onnx
from onnx import TensorProto, helper

from fdda_addon.core.formats.model import CONFIDENCE_OUTPUT, CONTROLS_INPUT, POSE_INPUT, POSITIONS_OUTPUT

from ..graph_builder import GraphBuilder
from ..model import TrainedModel
from .network_nodes import add_networks
from .pose_nodes import add_features, add_range
from .skinning_nodes import add_skinning

OPSET = 17
IR_VERSION = 8
"""Supported by ONNX Runtime 1.17 and later."""


def build_graph(trained_model: TrainedModel) -> onnx.ModelProto:
    """Build the ONNX model of a trained model, without metadata."""
    graph = GraphBuilder()
    features = add_features(graph, trained_model)
    clamped, outside = add_range(graph, features, trained_model)
    coefficients = add_networks(graph, features, clamped, trained_model)
    add_skinning(graph, features, coefficients, outside, trained_model)
    inputs = [helper.make_tensor_value_info(POSE_INPUT, TensorProto.FLOAT, ["N", len(trained_model.rig.joints), 4, 4])]
    if count := len(trained_model.rig.controls):
        inputs.append(helper.make_tensor_value_info(CONTROLS_INPUT, TensorProto.FLOAT, ["N", count]))
    outputs = [
        helper.make_tensor_value_info(POSITIONS_OUTPUT, TensorProto.FLOAT, ["N", trained_model.rig.vertex_count, 3]),
        helper.make_tensor_value_info(CONFIDENCE_OUTPUT, TensorProto.FLOAT, ["N", len(trained_model.partitions)]),
    ]
    proto = helper.make_graph(graph.nodes, "deformation", inputs, outputs, graph.constants)
    model = helper.make_model(proto, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="fdda")
    model.ir_version = IR_VERSION
    return model
