# SPDX-License-Identifier: GPL-3.0-or-later
"""Graphs made to hang whoever loads them, or to fill the memory: refused in a sentence before any runtime sees them."""

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from fdda_addon.core.errors import ModelError
from fdda_addon.core.model import CHECKSUM_KEY, ModelPartition, check_model
from fdda_addon.core.onnx_cost import OPERATORS, compute_graph_cost
from fdda_addon.core.onnx_file import read_onnx

from .tiny_model import J, V, constant, tiny_info, tiny_model


def refused(model, *words: str) -> str:
    data = model if isinstance(model, bytes) else model.SerializeToString()
    with pytest.raises(ModelError) as error:
        check_model(data, "m.onnx")
    text = str(error.value)
    for word in words:
        assert word in text
    assert text.endswith(".") and len(text) < 1200
    return text


def node(operator: str, *inputs: str, **attributes) -> onnx.NodeProto:
    return helper.make_node(operator, list(inputs), [f"{operator}_of_{inputs[0] if inputs else ''}"], **attributes)


def integers(name: str, *values: int) -> TensorProto:
    return numpy_helper.from_array(np.array(values, np.int64), name)


def endless_loop() -> onnx.ModelProto:
    """A Loop whose condition stays true."""
    body = helper.make_graph(
        [helper.make_node("Identity", ["going"], ["still"])],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, []),
            helper.make_tensor_value_info("going", TensorProto.BOOL, []),
        ],
        [helper.make_tensor_value_info("still", TensorProto.BOOL, [])],
    )
    return tiny_model(nodes=[helper.make_node("Loop", ["", ""], [], body=body)])


def test_a_loop_that_never_ends():
    refused(endless_loop(), "m.onnx' is refused: it has graphs inside of nodes, which train does not write; give one")


UNKNOWN = (
    "ConstantOfShape",
    "Expand",
    "Tile",
    "Range",
    "Identity",
    "RandomNormal",
    "Conv",
    "Scan",
    "SequenceEmpty",
    "x" * 500,
)


@pytest.mark.parametrize("operator", UNKNOWN, ids=lambda name: name[:20])
def test_an_operator_that_train_does_not_write(operator):
    model = tiny_model(nodes=[node(operator, "shape")])
    refused(model, f"it has the operator '{operator[:100]}", "which train does not write")


def test_a_constant_inside_of_a_node():
    refused(tiny_model(nodes=[helper.make_node("Constant", [], ["c"], value=constant("w"))]), "tensors inside of nodes")


def test_constants_that_would_be_multiplied_when_the_graph_is_loaded():
    """Two of 400 kB, whose product has 40 GB."""
    column, row = (np.zeros(shape, np.float32) for shape in ((100_000, 1), (1, 100_000)))
    tensors = [numpy_helper.from_array(array, name) for array, name in ((column, "upright"), (row, "lying"))]
    refused(tiny_model(nodes=[node("MatMul", "upright", "lying")], initializers=tensors), "of constants alone")


def test_a_pose_that_grows():
    """Every node is fine by itself."""
    tensors = [integers("lying", 1, -1), integers("upright", -1, 1)]
    nodes, value = [], "pose_matrices"
    for number in range(4):
        for way in ("lying", "upright"):
            nodes.append(helper.make_node("Reshape", [value, way], [f"{way}_{number}"]))
        nodes.append(helper.make_node("MatMul", [f"upright_{number}", f"lying_{number}"], [f"square_{number}"]))
        value = f"square_{number}"
    assert "more than its joints, vertices and shapes explain" in refused(tiny_model(nodes=nodes, initializers=tensors))
    nodes[2].op_type = "Add"
    refused(tiny_model(nodes=nodes[:6], initializers=tensors), "more than its joints, vertices and shapes explain")


def test_poses_that_are_multiplied_with_each_other():
    """Little for one pose, and the square of it for several."""
    wide = np.zeros((1, 16 * J, 3000), np.float32)
    tensors = [integers("rows", -1, 16 * J), numpy_helper.from_array(wide[0], "wide"), integers("flat", 1, -1)]
    nodes = [
        helper.make_node("Reshape", ["pose_matrices", "rows"], ["rows_of_poses"]),
        helper.make_node("MatMul", ["rows_of_poses", "wide"], ["many"]),
        helper.make_node("Reshape", ["many", "flat"], ["lying"]),
        helper.make_node("Transpose", ["lying"], ["upright"], perm=[1, 0]),
        helper.make_node("Mul", ["lying", "upright"], ["square"]),
    ]
    refused(tiny_model(nodes=nodes, initializers=tensors), "more than its")


def test_more_constants_than_are_explained():
    big = numpy_helper.from_array(np.zeros(4_000_000, np.float32), "big")
    refused(tiny_model(initializers=[big]), "its constants have 16000", "more than its joints, vertices and shapes")


def test_more_nodes_than_are_explained():
    refused(tiny_model(nodes=[helper.make_node("Relu", ["positions"], [f"r{i}"]) for i in range(1000)]), "1003 nodes")


def lying(tensor: TensorProto, **changes) -> TensorProto:
    for name, value in changes.items():
        if name == "dims":
            tensor.ClearField("dims")
            tensor.dims.extend(value)
        else:
            setattr(tensor, name, value)
    return tensor


@pytest.mark.parametrize(
    "tensor",
    [
        lying(constant("w"), dims=[1 << 40]),
        lying(constant("w"), dims=[1 << 62, 4]),
        lying(constant("w"), dims=[-1, 12]),
        lying(constant("w"), dims=[1] * 40),
        lying(constant("w"), raw_data=b""),
        lying(constant("w"), data_type=TensorProto.STRING),
        lying(constant("w"), data_type=TensorProto.DOUBLE),
        lying(constant("w"), data_type=999),
        helper.make_tensor("w", TensorProto.FLOAT, [2], [1.0, 2.0]),
        helper.make_tensor("w", TensorProto.STRING, [1], [b"x" * 100]),
    ],
)
def test_constants_that_lie(tensor):
    refused(tiny_model(initializers=[tensor]), "a constant 'w'")


def test_metadata_that_would_explain_anything():
    """A billion vertices in a file of a kilobyte."""
    count = 10**9
    partitions = (ModelPartition(0, (), 1, 0), ModelPartition(2, (1, 2), count - 1, 17))
    model = tiny_model(tiny_info(vertex_count=count, partitions=partitions).to_json())
    model.graph.output[0].type.tensor_type.shape.dim[1].dim_value = count
    assert "its metadata tells of a character that" in refused(model)


def test_two_constants_of_one_name():
    refused(tiny_model(initializers=[constant("zeros")]), "two constants 'zeros'")


def test_sparse_tensors():
    values, indices = numpy_helper.from_array(np.ones(1, np.float32), "s"), integers("i", 0)
    sparse = helper.make_sparse_tensor(values, indices, [1 << 40])
    refused(tiny_model(sparse=[sparse]), "sparse tensors")


def test_a_training_of_its_own_and_strange_versions():
    model = tiny_model()
    model.training_info.add()
    refused(model, "a training of its own")
    model = tiny_model()
    model.opset_import[0].version = 5
    refused(model, "operators of version 5")


@pytest.mark.parametrize(
    "broken",
    [
        node("Add", "nowhere", "zeros"),
        node("Add"),
        node("Relu", "positions"),  # twice, below: two values of one name
        node("Reshape", "positions", "axes"),
        node("Reshape", "positions", "zeros"),
        node("Reshape", "positions"),
        node("Transpose", "positions", perm=[0, 0, 1]),
        node("Transpose", "positions", perm=[0]),
        node("Concat", "positions", "axes", axis=0),
        node("Concat", "positions", axis=9),
        node("Split", "positions", "axes", axis=1),
        node("Slice", "positions", "axes"),
        node("Slice", "positions", "axes", "axes", "axes", "zeros"),
        node("Gather", "positions", "axes", axis=7),
        node("Unsqueeze", "positions", "shape"),
        node("ReduceSum", "positions", "axes"),
        node("MatMul", "positions", "positions"),
        node("MatMul", "positions"),
        node("Gemm", "positions", "positions"),
        node("Cast", "positions", to=TensorProto.STRING),
        node("Add", "positions", "pose_matrices"),
    ],
)  # fmt: skip
def test_nodes_that_do_not_fit(broken):
    nodes = [broken, broken] if broken.op_type == "Relu" else [broken]
    refused(tiny_model(nodes=nodes), "m.onnx' is refused: ")


def test_an_output_that_comes_out_otherwise():
    model = tiny_model()
    model.graph.node[1].input[1] = "other"
    model.graph.initializer.append(integers("other", 1, -1, 1))
    model.graph.node[2].input[1] = "one"
    model.graph.initializer.append(numpy_helper.from_array(np.float32(0), "one"))
    refused(model, "its output 'positions' comes out as (1, 1, 1), not as (1, 4, 3)")


def test_a_checksum_that_fits_and_one_that_does_not():
    model = tiny_model()
    check_model(model.SerializeToString(), "m.onnx")
    zeros = next(tensor for tensor in model.graph.initializer if tensor.name == "zeros")
    zeros.raw_data = b"\x00\x00\x80\x3f" + zeros.raw_data[4:]
    refused(model, "m.onnx' is damaged: its checksum is not that of its weights")


def test_a_model_without_a_checksum():
    model = tiny_model()
    model.metadata_props.remove(next(prop for prop in model.metadata_props if prop.key == CHECKSUM_KEY))
    refused(model, "m.onnx' is damaged: its checksum is not that of its weights")


@pytest.mark.parametrize("value", [[], ["x"], [0], [10**9], [8] * 99, "128"])
def test_hidden_layers_that_are_none(value):
    if value == []:
        pytest.skip("a network without hidden layers is one")
    refused(tiny_model(tiny_info(training={"hidden": value}).to_json()), "hidden layers that are none")


def test_the_shapes_are_those_that_the_runtime_finds():
    """Of every operator that a model may have."""
    rng = np.random.default_rng(0)
    tensors = {
        "w": rng.normal(size=(16, 5)).astype(np.float32),
        "b": np.zeros(5, np.float32),
        "i8": rng.integers(-9, 9, (5, 7)).astype(np.int8),
        "scale": np.float32(0.5),
        "zero": np.int8(0),
        "bytes_zero": np.uint8(0),
        **{name: np.array(v, np.int64) for name, v in {
            "flat": [0, J, 16], "rows": [-1, 16], "sizes": [3, 2], "start": [1], "end": [9], "axis": [2], "step": [2],
            "picks": [[0, 2], [1, 1]], "last": [-1], "two": [0, 3],
        }.items()},
    }  # fmt: skip
    nodes = [
        helper.make_node("Reshape", ["pose_matrices", "flat"], ["x"]),
        helper.make_node("MatMul", ["x", "w"], ["y"]),
        helper.make_node("Reshape", ["pose_matrices", "rows"], ["r"]),
        helper.make_node("Gemm", ["r", "w", "b"], ["g"], alpha=-1.0),
        helper.make_node("Gemm", ["w", "r"], ["gt"], transA=1, transB=1),
        *(helper.make_node(name, ["y", "b"], [name]) for name in ("Add", "Sub", "Mul", "Div")),
        *(helper.make_node(name, ["y", "b", "y"], [name]) for name in ("Max", "Min")),
        *(helper.make_node(name, ["y"], [name]) for name in ("Relu", "Sigmoid", "Tanh", "Erf", "Sqrt")),
        helper.make_node("Transpose", ["y"], ["t"], perm=[2, 0, 1]),
        helper.make_node("Transpose", ["y"], ["all_turned"]),
        helper.make_node("Concat", ["y", "x"], ["c"], axis=-1),
        helper.make_node("Split", ["y", "sizes"], ["s0", "s1"], axis=2),
        helper.make_node("Slice", ["x", "start", "end", "axis", "step"], ["sl"]),
        helper.make_node("Slice", ["x", "start", "end"], ["sl0"]),
        helper.make_node("Gather", ["x", "picks"], ["ga"], axis=1),
        helper.make_node("Unsqueeze", ["y", "two"], ["u"]),
        helper.make_node("ReduceSum", ["y", "last"], ["rs"], keepdims=0),
        helper.make_node("ReduceSum", ["y", "last"], ["rk"]),
        helper.make_node("DequantizeLinear", ["i8", "scale", "zero"], ["dq"]),
        helper.make_node("DynamicQuantizeLinear", ["y"], ["q", "qs", "qz"]),
        helper.make_node("MatMulInteger", ["q", "i8", "qz"], ["mi"]),
        helper.make_node("Cast", ["mi"], ["cast"], to=TensorProto.FLOAT),
    ]
    assert {n.op_type for n in nodes} == set(OPERATORS)
    outputs = [name for n in nodes for name in n.output]
    graph = helper.make_graph(
        nodes,
        "all",
        [helper.make_tensor_value_info("pose_matrices", TensorProto.FLOAT, ["N", J, 4, 4])],
        [helper.make_empty_tensor_value_info(name) for name in outputs],
        [numpy_helper.from_array(value, name) for name, value in tensors.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    model = onnx.shape_inference.infer_shapes(model)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    for poses in (1, 4):
        cost = compute_graph_cost(read_onnx(model.SerializeToString()), poses)
        assert cost.products == poses * J * (3 * 16 * 5 + 5 * 7)
        values = session.run(outputs, {"pose_matrices": rng.normal(size=(poses, J, 4, 4)).astype(np.float32)})
        assert [cost.shapes[name] for name in outputs] == [value.shape for value in values]


def test_the_tiny_model_is_good():
    assert check_model(tiny_model().SerializeToString(), "m.onnx").vertex_count == V
