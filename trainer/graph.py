# SPDX-License-Identifier: GPL-3.0-or-later
"""The model's ONNX graph: from pose matrices and controls to positions and confidence, in standard operators.

At one pose a frame the graph costs most of a microsecond a node, whatever the node does, and the time to read its
constants once: hence few nodes, products with matrices of ones and zeros in place of gathers, and little padding.
docs/experiments.md has the measurements. In the modules of the graph: N poses, J joints, C controls, Q pairs of joints,
F features, D deltas, P partitions, K basis shapes, V vertices.
"""

import onnx
from onnx import TensorProto, helper

from fdda_addon.core.model import CONFIDENCE_OUTPUT, CONTROLS_INPUT, POSE_INPUT, POSITIONS_OUTPUT

from .deformation import Deformation
from .network_nodes import add_networks
from .nodes import Graph
from .playback_nodes import add_playback
from .pose_nodes import add_features, add_range

OPSET = 17
IR_VERSION = 8
"""Old enough for ONNX Runtime 1.17."""


def build_graph(deformation: Deformation) -> onnx.ModelProto:
    """Build the model, without metadata."""
    graph = Graph()
    features = add_features(graph, deformation)
    clamped, outside = add_range(graph, features, deformation)
    coefficients = add_networks(graph, features, clamped, deformation)
    add_playback(graph, features, coefficients, outside, deformation)
    inputs = [helper.make_tensor_value_info(POSE_INPUT, TensorProto.FLOAT, ["N", len(deformation.rig.joints), 4, 4])]
    if count := deformation.inputs.control_count:
        inputs.append(helper.make_tensor_value_info(CONTROLS_INPUT, TensorProto.FLOAT, ["N", count]))
    outputs = [
        helper.make_tensor_value_info(POSITIONS_OUTPUT, TensorProto.FLOAT, ["N", deformation.rig.vertex_count, 3]),
        helper.make_tensor_value_info(CONFIDENCE_OUTPUT, TensorProto.FLOAT, ["N", len(deformation.partitions)]),
    ]
    proto = helper.make_graph(graph.nodes, "deformation", inputs, outputs, graph.constants)
    model = helper.make_model(proto, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="fdda")
    model.ir_version = IR_VERSION
    return model
