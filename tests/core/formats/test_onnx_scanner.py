# SPDX-License-Identifier: GPL-3.0-or-later
"""What the scanner finds in valid models, and in files that would make ONNX Runtime load other code or data."""

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from fdda_addon.core.errors import ModelError
from fdda_addon.core.formats.model import check_model
from fdda_addon.core.formats.onnx_file import OnnxContents, read_onnx

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


def node_with_tensors(*tensors: TensorProto) -> onnx.NodeProto:
    node = helper.make_node("Constant", [], ["c"])
    node.attribute.append(helper.make_attribute("values", list(tensors)))
    return node


def model_with_function() -> onnx.ModelProto:
    model = tiny_model()
    function = helper.make_function("com.example", "Run", ["x"], ["y"], [helper.make_node("Relu", ["x"], ["y"])], [])
    model.functions.append(function)
    return model


def model_with_training() -> onnx.ModelProto:
    model = tiny_model()
    model.training_info.add()
    return model


def sparse_tensor(external_part: str = "") -> onnx.SparseTensorProto:
    values, indices = numpy_helper.from_array(np.ones(1, np.float32), "s"), zeros_tensor("i")
    if external_part:
        with_external_data({"values": values, "indices": indices}[external_part])
    return helper.make_sparse_tensor(values, numpy_helper.from_array(np.zeros(1, np.int64), "i"), [4])


def with_location(location: int) -> TensorProto:
    """Return a tensor that says where its data is, without a file; 0 is in the model, 1 outside."""
    tensor = with_external_data(zeros_tensor("w"))
    tensor.data_location = location
    return tensor


FOREIGN_CONTENT = {
    "operator of a domain": (tiny_model(nodes=[CUSTOM_NODE]), "the operator 'com.example::Run'"),
    "operator of another spelling": (
        tiny_model(nodes=[helper.make_node("Relu", ["positions"], ["y"], domain="AI.ONNX")]),
        "the operator 'AI.ONNX::Relu'",
    ),
    "subgraph": (tiny_model(nodes=[in_subgraph(CUSTOM_NODE, 1)]), "graphs inside of nodes"),
    "list of subgraphs": (
        tiny_model(nodes=[helper.make_node("Choose", [], [], branches=[helper.make_graph([], "inner", [], [])] * 2)]),
        "graphs inside of nodes",
    ),
    "functions": (model_with_function(), "functions of its own"),
    "training": (model_with_training(), "a training of its own"),
    "external data": (tiny_model(initializers=[with_external_data(zeros_tensor("w"))]), "data in other files"),
    "external data marked as internal": (tiny_model(initializers=[with_location(0)]), "data in other files"),
    "tensor in a node": (
        tiny_model(nodes=[helper.make_node("Constant", [], ["c"], value=zeros_tensor("w"))]),
        "tensors inside of nodes",
    ),
    "tensors in a node": (
        tiny_model(nodes=[node_with_tensors(zeros_tensor("v"), with_external_data(zeros_tensor("w")))]),
        "a AttributeProto with the field 10",
    ),
    "typed elements": (
        tiny_model(initializers=[helper.make_tensor("w", TensorProto.FLOAT, [2], [1.0, 2.0])]),
        "a TensorProto with the field 4",
    ),
    "sparse tensor": (tiny_model(sparse=[sparse_tensor()]), "sparse tensors"),
    "sparse tensor with external data": (tiny_model(sparse=[sparse_tensor("values")]), "sparse tensors"),
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
    "zeros": bytes(1000),
    "ones": b"\xff" * 1000,
    "zip": b"PK\x03\x04" + bytes(100),
    "no graph": onnx.ModelProto(ir_version=8).SerializeToString(),
    "cut": VALID_MODEL[: len(VALID_MODEL) // 2],
    "cut by one": VALID_MODEL[:-1],
    "endless number": b"\x08" + b"\x80" * 1_000_000,
    "long message": VALID_MODEL + b"\x3a" + varint(2**62) + b"abc",
    "longest message": VALID_MODEL + b"\x3a" + b"\xff" * 9 + b"\x01" + b"abc",
    "cut key": VALID_MODEL + b"\x80",
    "cut double": VALID_MODEL + b"\x09abc",
    "group": VALID_MODEL + b"\x0b",
    "number for graph": VALID_MODEL + b"\x38\x05",
    "number for name": VALID_MODEL + protobuf_field(14, b"\x08" + varint(2**62) + b"\x12\x00"),
    "number for property": VALID_MODEL + b"\x70" + varint(2**40),
    "number for node": VALID_MODEL + protobuf_field(7, b"\x08\x01"),
    "number for domain": VALID_MODEL + protobuf_field(7, protobuf_field(1, b"\x38" + varint(2**61))),
    "number for shape": VALID_MODEL + protobuf_field(7, protobuf_field(11, b"\x10\x05")),
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
