# SPDX-License-Identifier: GPL-3.0-or-later
"""Mutated models, bound and played in Blender: each is refused in a sentence, or what is shown is what it says."""

import json
import math
from pathlib import Path

import bpy
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

import fdda_addon
from fdda_addon.core.model import CHECKSUM_KEY, METADATA_KEY
from fdda_addon.core.onnx_file import read_onnx
from fdda_addon.rig.reading import PoseEvaluator, read_model_rig
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.runtime.model_files import network_of
from fdda_addon.scene.scene_rig import find_rig

from .cases import ShortfallError, attempt, say
from .odd_values import mutated_bytes, mutated_json, to_json_text

OPERATORS = (
    "Loop", "If", "Scan", "ConstantOfShape", "Expand", "Tile", "Range", "RandomNormal", "Identity", "Concat", "MatMul",
    "Gemm", "Einsum", "Pad", "Resize", "NonZero", "Gather", "Slice", "Reshape", "Cast", "Exp", "Div", "Mul", "Where",
    "OneHot", "CumSum", "Trilu", "Multinomial", "StringNormalizer", "Optional", "SequenceConstruct", "LSTM", "Log",
)  # fmt: skip
FRAMES = (1, 9, 22)
NEAR = 1e-6
"""Of the largest position: what is shown may be so far from what the model says."""


def run(folder: Path, seed: int, first: int, end: int) -> None:
    """Bind and play the models of some numbers, the same for the same seed and number."""
    bpy.ops.wm.open_mainfile(filepath=str(folder / "elbow.blend"))
    fdda_addon.register()
    original = (folder / "elbow.onnx").read_bytes()
    for number in range(first, end):
        random = np.random.default_rng((seed, number))
        how, data = mutated(random, original)
        path = folder / "mutated.onnx"
        path.write_bytes(data)
        say(attempt("mutated models", f"model {seed}/{number} ({how})", lambda path=path: _play(path)))
        mesh_object = find_rig().mesh_object
        unbind(mesh_object)
        mesh_object.fdda.property_unset("status")
        if mesh_object.fdda.is_playing or [m.name for m in mesh_object.modifiers if not m.show_viewport]:
            raise ShortfallError("the rig was not given back")


def _play(path: Path) -> float:
    rig = find_rig()
    bind(rig, path)
    mesh_object, furthest = rig.mesh_object, 0.0
    for frame in FRAMES:
        bpy.context.scene.frame_set(frame)
        if mesh_object.fdda.mode == "RIG":
            if not mesh_object.fdda.status:
                raise ShortfallError("it was switched off without a reason")
            return 0.0
        network = network_of(mesh_object)
        pose, shown, controls = PoseEvaluator(rig, read_model_rig(rig, network.info)).evaluate()
        said = network.positions(pose[None], controls[None])[0].copy()
        if not np.isfinite(said).all():
            # Its weights are such. Where they are so at rest too, its status says it.
            continue
        off = float(np.abs(shown.astype(np.float64) - said).max())
        if off > NEAR * max(1.0, float(np.abs(said).max())):
            raise ShortfallError(f"what is shown is {off} m from what it says")
        furthest = max(furthest, off)
    return furthest


def mutated(random: np.random.Generator, original: bytes) -> tuple[str, bytes]:
    """How, and the bytes of a model that was changed at random."""
    kind = ("bytes", "metadata", "graph", "graph", "constants", "weights")[random.integers(6)]
    if kind == "bytes":
        return kind, mutated_bytes(random, original)
    model = onnx.load_from_string(original)
    {"metadata": _metadata, "graph": _graph, "constants": _constants, "weights": _weights}[kind](random, model)
    data = model.SerializeToString()
    if random.random() < 0.7:
        # One who does harm computes it anew; else nothing would be looked at behind it.
        try:
            checksum = read_onnx(data).checksum
        except ValueError:
            return kind, data
        for prop in model.metadata_props:
            if prop.key == CHECKSUM_KEY:
                prop.value = checksum
        data = model.SerializeToString()
    return kind, data


def _metadata(random: np.random.Generator, model: onnx.ModelProto) -> None:
    for prop in model.metadata_props:
        if prop.key == METADATA_KEY:
            if random.random() < 0.15:
                prop.value = mutated_bytes(random, prop.value.encode()).decode("utf-8", "replace")
            else:
                prop.value = to_json_text(mutated_json(random, json.loads(prop.value))).replace("\ud800", "?")


def _graph(random: np.random.Generator, model: onnx.ModelProto) -> None:
    graph = model.graph
    for _ in range(int(random.integers(1, 4))):
        node = graph.node[random.integers(len(graph.node))]
        names = [name for other in graph.node for name in (*other.input, *other.output)]
        names += [constant.name for constant in graph.initializer]
        name = names[random.integers(len(names))]
        kind = random.integers(9)
        if kind == 0:
            node.op_type = str(random.choice(OPERATORS))
        elif kind == 1 and node.input:
            node.input[random.integers(len(node.input))] = name
        elif kind == 2 and node.output:
            node.output[random.integers(len(node.output))] = name
        elif kind == 3:
            graph.node.remove(node)
        elif kind == 4:
            graph.node.insert(
                int(random.integers(len(graph.node))), onnx.NodeProto.FromString(node.SerializeToString())
            )
        elif kind == 5:
            count = int(random.integers(0, 4))
            inputs = [names[random.integers(len(names))] for _ in range(count)]
            graph.node.append(
                helper.make_node(
                    str(random.choice(OPERATORS)),
                    inputs,
                    [f"new{random.integers(9)}", name][: 1 + int(random.integers(2))],
                )
            )
        elif kind == 6:
            node.attribute.append(
                helper.make_attribute(
                    str(random.choice(["axis", "perm", "to", "keepdims", "axes", "alpha", "value"])),
                    int(random.integers(-5, 2**40)),
                )
            )
        elif kind == 7:
            end = (graph.input, graph.output)[random.integers(2)]
            shape = end[random.integers(len(end))].type.tensor_type.shape
            if shape.dim:
                shape.dim[random.integers(len(shape.dim))].dim_value = int(random.choice([-1, 0, 1, 7, 2**20, 2**40]))
        else:
            graph.initializer.append(helper.make_tensor(name, TensorProto.INT64, [2], [2**20, 2**20]))


def _constants(random: np.random.Generator, model: onnx.ModelProto) -> None:
    for _ in range(int(random.integers(1, 4))):
        tensor = model.graph.initializer[random.integers(len(model.graph.initializer))]
        kind = random.integers(6)
        if kind == 0 and tensor.dims:
            tensor.dims[random.integers(len(tensor.dims))] = int(random.choice([-1, 0, 1, 3, 2**16, 2**31, 2**40]))
        elif kind == 1:
            tensor.data_type = int(random.integers(0, 30))
        elif kind == 2:
            tensor.raw_data = mutated_bytes(random, tensor.raw_data or b"x")
        elif kind == 3:
            model.graph.initializer.remove(tensor)
        elif kind == 4:
            tensor.data_location = TensorProto.EXTERNAL
            tensor.external_data.add(key="location", value=str(random.choice(["/etc/passwd", "w.bin", "../x", ""])))
        elif _are_integers(tensor):
            array = numpy_helper.to_array(tensor).copy()
            if array.size:
                array.reshape(-1)[random.integers(array.size)] = int(
                    random.choice([-2, -1, 0, 1, 2, 100, 2**31, 2**62])
                )
                tensor.CopyFrom(numpy_helper.from_array(array, tensor.name))


def _are_integers(tensor: onnx.TensorProto) -> bool:
    """Whether a constant still holds integers, whatever was changed of it before."""
    inside = tensor.data_location != TensorProto.EXTERNAL and len(tensor.raw_data) == 8 * math.prod(tensor.dims)
    return tensor.data_type == TensorProto.INT64 and inside


def _weights(random: np.random.Generator, model: onnx.ModelProto) -> None:
    """Other numbers of the same kind and count: what plays, whatever it shows."""
    for _ in range(int(random.integers(1, 4))):
        tensor = model.graph.initializer[random.integers(len(model.graph.initializer))]
        if tensor.data_type == TensorProto.FLOAT:
            array = numpy_helper.to_array(tensor).copy()
            places = random.integers(max(1, array.size), size=min(array.size, 20))
            array.reshape(-1)[places] = random.choice(np.float32([0, -1, 1e3, 1e-30, 1e30, np.inf, -np.inf, np.nan]))
            tensor.CopyFrom(numpy_helper.from_array(array, tensor.name))
