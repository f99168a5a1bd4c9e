# SPDX-License-Identifier: GPL-3.0-or-later
"""ONNX files: what is found in valid ones, and which content could run code or fill the memory."""

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from fdda_addon.core.errors import ModelError
from fdda_addon.core.formats.model import CHECKSUM_KEY, check_model
from fdda_addon.core.formats.onnx_file import OnnxContents, infer_shapes, read_onnx

from ..tiny_model import JOINT_COUNT, VERTEX_COUNT, in_subgraph, tiny_info, tiny_model, with_external_data, zeros_tensor

CUSTOM_NODE = helper.make_node("Run", ["positions"], ["y"], domain="com.example")


def scan(model: onnx.ModelProto) -> OnnxContents:
    """Scan the serialized model."""
    return read_onnx(model.SerializeToString())


def test_contents_of_a_valid_model():
    contents = scan(tiny_model())
    assert contents.inputs == {"pose_matrices": ("N", JOINT_COUNT, 4, 4)}
    assert contents.outputs == {"positions": ("N", VERTEX_COUNT, 3)}
    assert contents.metadata == {"fdda": tiny_info().to_json(), "fdda_checksum": contents.checksum}
    assert [node.operator for node in contents.nodes] == ["ReduceSum", "Reshape", "Add"]


def test_shapes_of_inputs():
    inputs = [
        helper.make_tensor_value_info("controls", TensorProto.FLOAT, ["N", 2]),
        helper.make_tensor_value_info("scalar", TensorProto.INT64, []),
        helper.make_tensor_value_info("shapeless", TensorProto.FLOAT, None),
        helper.make_tensor_value_info("unnamed", TensorProto.FLOAT, [None, 2]),
    ]
    scanned_inputs = scan(tiny_model(inputs=inputs)).inputs
    assert scanned_inputs.pop("pose_matrices") == ("N", JOINT_COUNT, 4, 4)
    assert scanned_inputs == {"controls": ("N", 2), "scalar": (), "shapeless": (), "unnamed": ("?", 2)}


def model_with_function() -> onnx.ModelProto:
    model = tiny_model()
    function = helper.make_function("com.example", "Run", ["x"], ["y"], [helper.make_node("Relu", ["x"], ["y"])], [])
    model.functions.append(function)
    return model


def model_with_training() -> onnx.ModelProto:
    model = tiny_model()
    model.training_info.add()
    return model


FOREIGN_CONTENT = {
    "operator of a domain": (tiny_model(nodes=[CUSTOM_NODE]), "the operator 'com.example::Run'"),
    "operator of another spelling": (
        tiny_model(nodes=[helper.make_node("Relu", ["positions"], ["y"], domain="AI.ONNX")]),
        "the operator 'AI.ONNX::Relu'",
    ),
    "subgraph": (tiny_model(nodes=[in_subgraph(CUSTOM_NODE, 1)]), "graphs inside of nodes"),
    "functions": (model_with_function(), "functions of its own"),
    "training": (model_with_training(), "a training of its own"),
    "external data": (tiny_model(initializers=[with_external_data(zeros_tensor("w"))]), "data in other files"),
    "tensor in a node": (
        tiny_model(nodes=[helper.make_node("Constant", [], ["c"], value=zeros_tensor("w"))]),
        "tensors inside of nodes",
    ),
    "typed elements": (
        tiny_model(initializers=[helper.make_tensor("w", TensorProto.FLOAT, [2], [1.0, 2.0])]),
        "a TensorProto with the field 4",
    ),
    "text of a node": (
        tiny_model(nodes=[helper.make_node("Relu", ["positions"], ["y"], mode="x")]),
        "a AttributeProto with the field 4",
    ),
}


@pytest.mark.parametrize(("model", "words"), FOREIGN_CONTENT.values(), ids=FOREIGN_CONTENT.keys())
def test_content_that_the_trainer_does_not_write_is_refused(model, words):
    with pytest.raises(ModelError) as error:
        check_model(model.SerializeToString(), "m.onnx")
    assert f"it has {words}" in str(error.value) and "which train does not write; give one that train made." in str(
        error.value
    )


def test_a_graph_in_two_messages_is_merged():
    """Protobuf merges a message that is written twice, so the scanner must read the second part too."""
    second_part = onnx.ModelProto()
    second_part.graph.node.append(CUSTOM_NODE)
    data = tiny_model().SerializeToString() + second_part.SerializeToString()
    assert onnx.load_from_string(data).graph.node[-1].domain == "com.example"
    assert read_onnx(data).nodes[-1].operator == "com.example::Run"


def test_text_of_fixed_width_is_refused():
    """Protobuf ignores a field of another wire type; the scanner must not take it for the name of the operator."""
    loop = protobuf_field(4, b"Loop") + varint(4 << 3 | 5) + b"Relu"
    node = onnx.NodeProto.FromString(loop)
    assert node.op_type == "Loop"
    with pytest.raises(ValueError, match="it is not an ONNX file"):
        read_onnx(VALID_MODEL + protobuf_field(7, protobuf_field(1, loop)))


def varint(value: int) -> bytes:
    """Encode an integer as protobuf does: 7 bits per byte, the lowest first."""
    encoded = bytearray()
    while value >= 0x80:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*encoded, value])


def protobuf_field(field_number: int, content: bytes, key_bits: int = 0) -> bytes:
    """Encode a length-delimited protobuf field, with additional bits in its key."""
    return varint(field_number << 3 | 2 | key_bits) + varint(len(content)) + content


VALID_MODEL = tiny_model().SerializeToString()


@pytest.mark.parametrize("key_bits", [1 << 32, 1 << 34, 1 << 40, 1 << 63])
def test_a_field_with_an_overlong_key_is_refused(key_bits):
    """Some readers use only 32 bits of a key and would read this field as a second graph."""
    hidden_graph = onnx.GraphProto()
    hidden_graph.node.append(CUSTOM_NODE)
    with pytest.raises(ValueError, match="it is not an ONNX file"):
        read_onnx(VALID_MODEL + protobuf_field(7, hidden_graph.SerializeToString(), key_bits))


INVALID_FILES = {
    "empty": b"",
    "text": b"this is not a model, whatever its name says\n" * 20,
    "no graph": onnx.ModelProto(ir_version=8).SerializeToString(),
    "cut": VALID_MODEL[: len(VALID_MODEL) // 2],
    "long message": VALID_MODEL + b"\x3a" + varint(2**62) + b"abc",
    "group": VALID_MODEL + b"\x0b",
    "number for graph": VALID_MODEL + b"\x38\x05",
    "name that is no text": VALID_MODEL + protobuf_field(7, protobuf_field(11, protobuf_field(1, b"\xff\xfe"))),
}


@pytest.mark.parametrize("data", INVALID_FILES.values(), ids=INVALID_FILES.keys())
def test_invalid_bytes_are_refused(data):
    with pytest.raises(ValueError, match="it is not an ONNX file"):
        read_onnx(data)


@pytest.mark.parametrize("seed", range(8))
def test_random_damage_raises_only_value_errors(seed):
    """The scanner raises nothing but ValueError for bytes that are flipped, removed, repeated or overwritten."""
    rng = np.random.default_rng(seed)
    valid_bytes = tiny_model(metadata="{}").SerializeToString()
    refused_count = 0
    for _ in range(60):
        data = bytearray(valid_bytes)
        for _ in range(rng.integers(1, 4)):
            offset = int(rng.integers(len(data)))
            damage_kind = rng.integers(4)
            if damage_kind == 0:
                data[offset] ^= 1 << int(rng.integers(8))
            elif damage_kind == 1:
                data[offset] = int(rng.integers(256))
            elif damage_kind == 2:
                del data[offset : offset + int(rng.integers(1, 20))]
            else:
                data[offset:offset] = data[offset : offset + int(rng.integers(1, 20))]
        try:
            read_onnx(bytes(data))
        except ValueError:
            refused_count += 1
    assert 5 < refused_count < 60, "the damage is too small or too large for a meaningful test"


def assert_refused(model, *phrases: str) -> str:
    """Check that the model is refused with one short sentence that contains all phrases; return the sentence."""
    data = model if isinstance(model, bytes) else model.SerializeToString()
    with pytest.raises(ModelError) as error:
        check_model(data, "m.onnx")
    text = str(error.value)
    for phrase in phrases:
        assert phrase in text
    assert text.endswith(".") and len(text) < 1200
    return text


def make_node(operator: str, *inputs: str, **attributes) -> onnx.NodeProto:
    """Return a node whose output is named after the operator and the first input."""
    return helper.make_node(operator, list(inputs), [f"{operator}_of_{inputs[0] if inputs else ''}"], **attributes)


def integer_tensor(name: str, *values: int) -> TensorProto:
    """Return a constant of int64 values."""
    return numpy_helper.from_array(np.array(values, np.int64), name)


@pytest.mark.parametrize("operator", ["ConstantOfShape", "Scan", "x" * 500], ids=lambda name: name[:20])
def test_a_forbidden_operator_is_refused(operator):
    model = tiny_model(nodes=[make_node(operator, "shape")])
    assert_refused(model, f"it has the operator '{operator[:100]}", "which train does not write")


@pytest.mark.parametrize("data_type", [TensorProto.STRING, TensorProto.DOUBLE])
def test_a_cast_to_another_type_than_floats_is_refused(data_type):
    assert_refused(tiny_model(nodes=[make_node("Cast", "shape", to=data_type)]), "it has the operator 'Cast'")


def test_a_product_of_constants_is_refused():
    """Two constants of 400 kB, whose product would have 40 GB."""
    column, row = (np.zeros(shape, np.float32) for shape in ((100_000, 1), (1, 100_000)))
    tensors = [numpy_helper.from_array(array, name) for array, name in ((column, "column_matrix"), (row, "row_matrix"))]
    assert_refused(
        tiny_model(nodes=[make_node("MatMul", "column_matrix", "row_matrix")], initializers=tensors),
        "bytes explain",
    )


def test_a_product_of_poses_with_each_other_is_refused():
    """The product is small for one pose and grows with the square of the number of poses."""
    wide_matrix = np.zeros((1, 16 * JOINT_COUNT, 3000), np.float32)
    tensors = [
        integer_tensor("rows", -1, 16 * JOINT_COUNT),
        numpy_helper.from_array(wide_matrix[0], "wide"),
        integer_tensor("flat", 1, -1),
    ]
    nodes = [
        helper.make_node("Reshape", ["pose_matrices", "rows"], ["rows_of_poses"]),
        helper.make_node("MatMul", ["rows_of_poses", "wide"], ["many"]),
        helper.make_node("Reshape", ["many", "flat"], ["row_matrix"]),
        helper.make_node("Transpose", ["row_matrix"], ["column_matrix"], perm=[1, 0]),
        helper.make_node("Mul", ["row_matrix", "column_matrix"], ["square"]),
    ]
    assert_refused(tiny_model(nodes=nodes, initializers=tensors), "bytes explain")


@pytest.mark.parametrize(
    "changes",
    [{"raw_data": b""}, {"data_type": TensorProto.STRING}, {"data_type": TensorProto.FLOAT16, "raw_data": b""}],
)
def test_constants_with_a_wrong_type_or_size_are_refused(changes):
    tensor = zeros_tensor("w")
    for name, value in changes.items():
        setattr(tensor, name, value)
    assert_refused(tiny_model(initializers=[tensor]), "a constant 'w'")


def test_two_constants_with_one_name_are_refused():
    assert_refused(tiny_model(initializers=[zeros_tensor("zeros")]), "two constants 'zeros'")


@pytest.mark.parametrize("version", [5, 22])
def test_unknown_versions_are_refused(version: int):
    model = tiny_model()
    model.opset_import[0].version = version
    assert_refused(model, f"the operator set version [{version}]")


@pytest.mark.parametrize(
    "wrong_node",
    [
        make_node("Add", "nowhere", "zeros"),
        make_node("Add"),
        make_node("Relu", "positions"),  # added twice below, so that two values have one name
        make_node("Reshape", "positions", "axes"),
        make_node("Transpose", "positions", perm=[0]),
        make_node("Concat", "positions", axis=9),
        make_node("Split", "positions", "axes", axis=1),
        make_node("Gather", "positions", "axes", axis=7),
        make_node("ReduceSum", "positions", "axes"),
        make_node("MatMul", "positions", "positions"),
    ],
)  # fmt: skip
def test_nodes_with_wrong_inputs_or_attributes_are_refused(wrong_node):
    """The reader or ONNX Runtime refuses them."""
    nodes = [wrong_node, wrong_node] if wrong_node.op_type == "Relu" else [wrong_node]
    data = tiny_model(nodes=nodes).SerializeToString()
    with pytest.raises(Exception) as error:
        check_model(data, "m.onnx")
        session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
        session.run(None, {"pose_matrices": np.zeros((2, JOINT_COUNT, 4, 4), np.float32)})
    assert isinstance(error.value, ModelError) or type(error.value).__module__.startswith("onnxruntime")


def test_a_wrong_checksum_is_refused():
    model = tiny_model()
    check_model(model.SerializeToString(), "m.onnx")
    zeros = next(tensor for tensor in model.graph.initializer if tensor.name == "zeros")
    zeros.raw_data = b"\x00\x00\x80\x3f" + zeros.raw_data[4:]
    assert_refused(model, "m.onnx' is damaged: its checksum is not that of its weights")


def test_a_model_without_a_checksum_is_refused():
    model = tiny_model()
    model.metadata_props.remove(next(prop for prop in model.metadata_props if prop.key == CHECKSUM_KEY))
    assert_refused(model, "m.onnx' is damaged: its checksum is not that of its weights")


def test_computed_shapes_equal_those_of_onnx_runtime():
    """The graph contains every operator that a model may have."""
    rng = np.random.default_rng(0)
    tensors = {
        "w": rng.normal(size=(16, 5)).astype(np.float32),
        "b": np.zeros(5, np.float32),
        **{name: np.array(v, np.int64) for name, v in {
            "flat": [0, JOINT_COUNT, 16], "rows": [-1, 16], "sizes": [3, 2], "start": [1], "end": [9], "axis": [2],
            "step": [2], "picks": [[0, 2], [1, 1]], "last": [-1],
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
        helper.make_node("ReduceSum", ["y", "last"], ["rs"], keepdims=0),
        helper.make_node("ReduceSum", ["y", "last"], ["rk"]),
    ]
    outputs = [name for n in nodes for name in n.output]
    graph = helper.make_graph(
        nodes,
        "all",
        [helper.make_tensor_value_info("pose_matrices", TensorProto.FLOAT, ["N", JOINT_COUNT, 4, 4])],
        [helper.make_empty_tensor_value_info(name) for name in outputs],
        [numpy_helper.from_array(value, name) for name, value in tensors.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    model = onnx.shape_inference.infer_shapes(model)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    for poses in (1, 4):
        shapes = infer_shapes(
            read_onnx(model.SerializeToString()), {"pose_matrices": (poses, JOINT_COUNT, 4, 4)}, poses
        )
        values = session.run(outputs, {"pose_matrices": rng.normal(size=(poses, JOINT_COUNT, 4, 4)).astype(np.float32)})
        assert [shapes[name] for name in outputs] == [value.shape for value in values]
