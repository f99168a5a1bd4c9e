# SPDX-License-Identifier: GPL-3.0-or-later
"""What the scanner finds in valid models, and in files that would make ONNX Runtime load other code or data."""

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from fdda_addon.core.errors import ModelError
from fdda_addon.core.model import check_model
from fdda_addon.core.onnx_file import MAX_DEPTH, OnnxContents, read_onnx

from .tiny_model import JOINT_COUNT, VERTEX_COUNT, in_subgraph, tiny_info, tiny_model, with_external_data, zeros_tensor

CUSTOM_NODE = helper.make_node("Run", ["positions"], ["y"], domain="com.example")


def scan(model: onnx.ModelProto) -> OnnxContents:
    """Scan the serialized model."""
    return read_onnx(model.SerializeToString())


def test_contents_of_a_valid_model():
    contents = scan(tiny_model())
    assert contents.inputs == {"pose_matrices": ("N", JOINT_COUNT, 4, 4)}
    assert contents.outputs == {"positions": ("N", VERTEX_COUNT, 3)}
    assert contents.metadata == {"fdda": tiny_info().to_json(), "fdda_checksum": contents.checksum}
    assert contents.custom_operators == set() and contents.external_files == set()


def test_all_inputs_are_found():
    inputs = [
        helper.make_tensor_value_info("controls", TensorProto.FLOAT, ["N", 2]),
        helper.make_tensor_value_info("scalar", TensorProto.INT64, []),
        helper.make_tensor_value_info("shapeless", TensorProto.FLOAT, None),
        helper.make_tensor_sequence_value_info("sequence", TensorProto.FLOAT, None),
        helper.make_tensor_value_info("unnamed", TensorProto.FLOAT, [None, 2]),
    ]
    scanned_inputs = scan(tiny_model(inputs=inputs)).inputs
    assert scanned_inputs.pop("pose_matrices") == ("N", JOINT_COUNT, 4, 4)
    assert scanned_inputs.pop("controls") == ("N", 2)
    assert scanned_inputs.pop("unnamed") == ("?", 2)
    assert scanned_inputs == {"scalar": (), "shapeless": (), "sequence": ()}


def test_standard_operators_with_a_domain_are_not_custom():
    node = helper.make_node("Relu", ["positions"], ["y"], domain="ai.onnx")
    assert scan(tiny_model(nodes=[node])).custom_operators == set()


@pytest.mark.parametrize("domain", ["com.example", "ai.onnx.ml", "com.microsoft", "AI.ONNX", " "])
def test_custom_operators_are_found(domain):
    node = helper.make_node("Run", ["positions"], ["y"], domain=domain)
    assert scan(tiny_model(nodes=[node])).custom_operators == {f"{domain}::Run"}


@pytest.mark.parametrize("depth", [1, 2, MAX_DEPTH])
def test_custom_operators_in_subgraphs_are_found(depth):
    assert scan(tiny_model(nodes=[in_subgraph(CUSTOM_NODE, depth)])).custom_operators == {"com.example::Run"}


def test_subgraphs_nested_too_deeply_are_refused():
    with pytest.raises(ValueError, match="its graphs are nested too deeply"):
        scan(tiny_model(nodes=[in_subgraph(CUSTOM_NODE, MAX_DEPTH + 1)]))


def test_custom_operators_in_a_list_of_subgraphs_are_found():
    graph = helper.make_graph([CUSTOM_NODE], "inner", [], [])
    node = helper.make_node("Choose", [], [], branches=[graph, graph])
    assert scan(tiny_model(nodes=[node])).custom_operators == {"com.example::Run"}


def test_functions_of_the_file_are_found():
    model = tiny_model()
    function = helper.make_function("com.example", "Run", ["x"], ["y"], [helper.make_node("Relu", ["x"], ["y"])], [])
    model.functions.append(function)
    assert scan(model).custom_operators == {"a function of the file's own"}


def test_external_data_of_an_initializer_is_found():
    assert scan(tiny_model(initializers=[with_external_data(zeros_tensor("w"))])).external_files == {"weights.bin"}


def test_external_data_marked_as_internal_is_found():
    tensor = with_external_data(zeros_tensor("w"), "/etc/passwd")
    tensor.data_location = TensorProto.DEFAULT
    assert scan(tiny_model(initializers=[tensor])).external_files == {"/etc/passwd"}


def test_external_data_without_a_file_name_is_found():
    tensor = zeros_tensor("w")
    tensor.data_location = TensorProto.EXTERNAL
    assert scan(tiny_model(initializers=[tensor])).external_files == {""}


def test_external_data_of_a_constant_is_found():
    node = helper.make_node("Constant", [], ["c"], value=with_external_data(zeros_tensor("w")))
    assert scan(tiny_model(nodes=[node])).external_files == {"weights.bin"}
    assert scan(tiny_model(nodes=[in_subgraph(node, 2)])).external_files == {"weights.bin"}


def test_external_data_of_a_list_of_tensors_is_found():
    node = helper.make_node("Constant", [], ["c"])
    node.attribute.append(helper.make_attribute("values", [zeros_tensor("v"), with_external_data(zeros_tensor("w"))]))
    assert scan(tiny_model(nodes=[node])).external_files == {"weights.bin"}


def test_external_data_of_an_initializer_in_a_subgraph_is_found():
    graph = helper.make_graph([], "inner", [], [], [with_external_data(zeros_tensor("w"))])
    node = helper.make_node("If", ["c"], ["y"], then_branch=graph, else_branch=graph)
    assert scan(tiny_model(nodes=[node])).external_files == {"weights.bin"}


@pytest.mark.parametrize("tensor_name", ["values", "indices"])
def test_external_data_of_sparse_tensors_is_found(tensor_name):
    tensors = {
        "values": numpy_helper.from_array(np.ones(1, np.float32), "s"),
        "indices": numpy_helper.from_array(np.zeros(1, np.int64), "i"),
    }
    with_external_data(tensors[tensor_name])
    sparse_tensor = helper.make_sparse_tensor(tensors["values"], tensors["indices"], [4])
    assert scan(tiny_model(sparse=[sparse_tensor])).external_files == {"weights.bin"}
    node = helper.make_node("Constant", [], ["c"])
    node.attribute.append(helper.make_attribute("sparse_value", sparse_tensor))
    assert scan(tiny_model(nodes=[node])).external_files == {"weights.bin"}


def test_a_graph_in_two_messages_is_merged():
    """Protobuf merges a message that is written twice, so the scanner must read the second part too."""
    second_part = onnx.ModelProto()
    second_part.graph.node.append(CUSTOM_NODE)
    second_part.graph.initializer.append(with_external_data(zeros_tensor("w")))
    data = tiny_model().SerializeToString() + second_part.SerializeToString()
    assert onnx.load_from_string(data).graph.node[-1].domain == "com.example"
    contents = read_onnx(data)
    assert contents.custom_operators == {"com.example::Run"} and contents.external_files == {"weights.bin"}


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
    with pytest.raises(ValueError, match="not an ONNX file"):
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
    with pytest.raises(ValueError, match="not an ONNX file"):
        read_onnx(data)


@pytest.mark.parametrize("seed", range(8))
def test_random_damage_raises_only_value_errors(seed):
    """The scanner raises nothing but ValueError for bytes that are flipped, removed, repeated or overwritten."""
    rng = np.random.default_rng(seed)
    node = in_subgraph(helper.make_node("Constant", [], ["c"], value=zeros_tensor("w")), 2)
    valid_bytes = tiny_model(nodes=[node], metadata="{}").SerializeToString()
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


def test_every_truncation_is_refused():
    for end in range(len(VALID_MODEL)):
        with pytest.raises(ModelError):
            check_model(VALID_MODEL[:end], "m.onnx")
