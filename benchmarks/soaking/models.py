# SPDX-License-Identifier: GPL-3.0-or-later
"""Soak test of mutated models, bound and played in Blender: each is refused, or the mesh shows its exact output."""

import hashlib
import json
import math
from pathlib import Path

import bpy
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

import fdda_addon
from fdda_addon.core.formats.model import CHECKSUM_KEY, METADATA_KEY
from fdda_addon.rig.reading import PoseEvaluator, read_model_rig
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.runtime.model_files import network_of
from fdda_addon.scene.scene_rig import find_rig

from .cases import CaseFailedError, print_case, run_case
from .odd_values import mutate_bytes, mutate_json, to_json_text

OPERATORS = (
    "Loop", "If", "Scan", "ConstantOfShape", "Expand", "Tile", "Range", "RandomNormal", "Identity", "Concat", "MatMul",
    "Gemm", "Einsum", "Pad", "Resize", "NonZero", "Gather", "Slice", "Reshape", "Cast", "Exp", "Div", "Mul", "Where",
    "OneHot", "CumSum", "Trilu", "Multinomial", "StringNormalizer", "Optional", "SequenceConstruct", "LSTM", "Log",
)  # fmt: skip
FRAMES = (1, 9, 22)
MAX_RELATIVE_ERROR = 1e-6
"""Limit of the distance between shown and expected positions, relative to the largest position."""


def run(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Bind and play mutated models; the seed and the index of a case determine its model."""
    bpy.ops.wm.open_mainfile(filepath=str(folder / "elbow.blend"))
    fdda_addon.register()
    original = (folder / "elbow.onnx").read_bytes()
    for case_index in range(first_case, end_case):
        random = np.random.default_rng((seed, case_index))
        mutation, data = mutate_model(random, original)
        path = folder / "mutated.onnx"
        path.write_bytes(data)
        print_case(run_case("mutated models", f"model {seed}/{case_index} ({mutation})", lambda path=path: _play(path)))
        mesh_object = find_rig().mesh_object
        unbind(mesh_object)
        mesh_object.fdda.property_unset("status")
        if mesh_object.fdda.is_playing or [m.name for m in mesh_object.modifiers if not m.show_viewport]:
            raise CaseFailedError("the rig was not restored")


def _play(path: Path) -> float:
    """Bind and play a model; return the largest distance between shown and expected positions, meters."""
    rig = find_rig()
    bind(rig, path)
    mesh_object, max_error_m = rig.mesh_object, 0.0
    for frame in FRAMES:
        bpy.context.scene.frame_set(frame)
        if mesh_object.fdda.mode == "RIG":
            if not mesh_object.fdda.status:
                raise CaseFailedError("the model was disabled without a message")
            return 0.0
        network = network_of(mesh_object)
        pose, shown_positions, controls = PoseEvaluator(rig, read_model_rig(rig, network.info)).evaluate()
        expected_positions = network.positions(pose[None], controls[None])[0].copy()
        if not np.isfinite(expected_positions).all():
            continue  # Mutated weights may give infinity or NaN in some poses.
        error_m = float(np.abs(shown_positions.astype(np.float64) - expected_positions).max())
        if error_m > MAX_RELATIVE_ERROR * max(1.0, float(np.abs(expected_positions).max())):
            raise CaseFailedError(f"the mesh is {error_m} m from the output of the model")
        max_error_m = max(max_error_m, error_m)
    return max_error_m


def mutate_model(random: np.random.Generator, original: bytes) -> tuple[str, bytes]:
    """Return the kind of a random mutation, and the bytes of the mutated model."""
    kind = ("bytes", "metadata", "graph", "graph", "constants", "weights")[random.integers(6)]
    if kind == "bytes":
        return kind, mutate_bytes(random, original)
    model = onnx.load_from_string(original)
    mutations = {"graph": _mutate_graph, "constants": _mutate_constants}
    mutations |= {"metadata": _mutate_metadata, "weights": _mutate_weights}
    mutations[kind](random, model)
    data = model.SerializeToString()
    if random.random() < 0.7:
        # An attacker computes a valid checksum; without one, the reader refuses the file before its other checks.
        checksum = hashlib.sha256(model.graph.SerializeToString()).hexdigest()
        for prop in model.metadata_props:
            if prop.key == CHECKSUM_KEY:
                prop.value = checksum
        data = model.SerializeToString()
    return kind, data


def _mutate_metadata(random: np.random.Generator, model: onnx.ModelProto) -> None:
    for prop in model.metadata_props:
        if prop.key == METADATA_KEY:
            if random.random() < 0.15:
                prop.value = mutate_bytes(random, prop.value.encode()).decode("utf-8", "replace")
            else:
                prop.value = to_json_text(mutate_json(random, json.loads(prop.value))).replace("\ud800", "?")


def _mutate_graph(random: np.random.Generator, model: onnx.ModelProto) -> None:
    graph = model.graph
    for _ in range(int(random.integers(1, 4))):
        node = graph.node[random.integers(len(graph.node))]
        names = [name for other in graph.node for name in (*other.input, *other.output)]
        names += [constant.name for constant in graph.initializer]
        name = names[random.integers(len(names))]
        mutation = random.integers(9)
        if mutation == 0:
            node.op_type = str(random.choice(OPERATORS))
        elif mutation == 1 and node.input:
            node.input[random.integers(len(node.input))] = name
        elif mutation == 2 and node.output:
            node.output[random.integers(len(node.output))] = name
        elif mutation == 3:
            graph.node.remove(node)
        elif mutation == 4:
            graph.node.insert(
                int(random.integers(len(graph.node))), onnx.NodeProto.FromString(node.SerializeToString())
            )
        elif mutation == 5:
            count = int(random.integers(0, 4))
            inputs = [names[random.integers(len(names))] for _ in range(count)]
            graph.node.append(
                helper.make_node(
                    str(random.choice(OPERATORS)),
                    inputs,
                    [f"new{random.integers(9)}", name][: 1 + int(random.integers(2))],
                )
            )
        elif mutation == 6:
            node.attribute.append(
                helper.make_attribute(
                    str(random.choice(["axis", "perm", "to", "keepdims", "axes", "alpha", "value"])),
                    int(random.integers(-5, 2**40)),
                )
            )
        elif mutation == 7:
            values = (graph.input, graph.output)[random.integers(2)]
            shape = values[random.integers(len(values))].type.tensor_type.shape
            if shape.dim:
                shape.dim[random.integers(len(shape.dim))].dim_value = int(random.choice([-1, 0, 1, 7, 2**20, 2**40]))
        else:
            graph.initializer.append(helper.make_tensor(name, TensorProto.INT64, [2], [2**20, 2**20]))


def _mutate_constants(random: np.random.Generator, model: onnx.ModelProto) -> None:
    for _ in range(int(random.integers(1, 4))):
        tensor = model.graph.initializer[random.integers(len(model.graph.initializer))]
        mutation = random.integers(6)
        if mutation == 0 and tensor.dims:
            tensor.dims[random.integers(len(tensor.dims))] = int(random.choice([-1, 0, 1, 3, 2**16, 2**31, 2**40]))
        elif mutation == 1:
            tensor.data_type = int(random.integers(0, 30))
        elif mutation == 2:
            tensor.raw_data = mutate_bytes(random, tensor.raw_data or b"x")
        elif mutation == 3:
            model.graph.initializer.remove(tensor)
        elif mutation == 4:
            tensor.data_location = TensorProto.EXTERNAL
            tensor.external_data.add(key="location", value=str(random.choice(["/etc/passwd", "w.bin", "../x", ""])))
        elif _holds_integers(tensor):
            array = numpy_helper.to_array(tensor).copy()
            if array.size:
                array.reshape(-1)[random.integers(array.size)] = int(
                    random.choice([-2, -1, 0, 1, 2, 100, 2**31, 2**62])
                )
                tensor.CopyFrom(numpy_helper.from_array(array, tensor.name))


def _holds_integers(tensor: onnx.TensorProto) -> bool:
    """Return whether a constant still holds integers after earlier mutations."""
    has_data = tensor.data_location != TensorProto.EXTERNAL and len(tensor.raw_data) == 8 * math.prod(tensor.dims)
    return tensor.data_type == TensorProto.INT64 and has_data


def _mutate_weights(random: np.random.Generator, model: onnx.ModelProto) -> None:
    """Replace some network weights. The model still plays, but its output is arbitrary."""
    for _ in range(int(random.integers(1, 4))):
        tensor = model.graph.initializer[random.integers(len(model.graph.initializer))]
        if tensor.data_type == TensorProto.FLOAT:
            array = numpy_helper.to_array(tensor).copy()
            indices = random.integers(max(1, array.size), size=min(array.size, 20))
            array.reshape(-1)[indices] = random.choice(np.float32([0, -1, 1e3, 1e-30, 1e30, np.inf, -np.inf, np.nan]))
            tensor.CopyFrom(numpy_helper.from_array(array, tensor.name))
