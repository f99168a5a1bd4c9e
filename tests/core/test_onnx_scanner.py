# SPDX-License-Identifier: GPL-3.0-or-later
"""What the scanner finds in ONNX files, good ones and such that would have ONNX Runtime load something else."""

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from fdda_addon.core.errors import ModelError
from fdda_addon.core.model import check_model
from fdda_addon.core.onnx_file import MAX_DEPTH, OnnxContents, read_onnx

from .tiny_model import J, V, constant, external, in_subgraph, tiny_info, tiny_model

CUSTOM = helper.make_node("Run", ["positions"], ["y"], domain="com.example")


def scan(model: onnx.ModelProto) -> OnnxContents:
    return read_onnx(model.SerializeToString())


def test_a_good_model():
    contents = scan(tiny_model())
    assert contents.inputs == {"pose_matrices": ("N", J, 4, 4)}
    assert contents.outputs == {"positions": ("N", V, 3)}
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
    found = scan(tiny_model(inputs=inputs)).inputs
    assert found.pop("pose_matrices") == ("N", J, 4, 4)
    assert found.pop("controls") == ("N", 2)
    assert found.pop("unnamed") == ("?", 2)
    assert found == {"scalar": (), "shapeless": (), "sequence": ()}


def test_standard_operators_by_their_full_name_are_no_custom_ones():
    node = helper.make_node("Relu", ["positions"], ["y"], domain="ai.onnx")
    assert scan(tiny_model(nodes=[node])).custom_operators == set()


@pytest.mark.parametrize("domain", ["com.example", "ai.onnx.ml", "com.microsoft", "AI.ONNX", " "])
def test_custom_operators(domain):
    node = helper.make_node("Run", ["positions"], ["y"], domain=domain)
    assert scan(tiny_model(nodes=[node])).custom_operators == {f"{domain}::Run"}


@pytest.mark.parametrize("depth", [1, 2, MAX_DEPTH])
def test_custom_operators_in_subgraphs(depth):
    assert scan(tiny_model(nodes=[in_subgraph(CUSTOM, depth)])).custom_operators == {"com.example::Run"}


def test_subgraphs_nested_too_deeply():
    with pytest.raises(ValueError, match="its graphs are nested too deeply"):
        scan(tiny_model(nodes=[in_subgraph(CUSTOM, MAX_DEPTH + 1)]))


def test_custom_operators_in_a_list_of_subgraphs():
    graph = helper.make_graph([CUSTOM], "inner", [], [])
    node = helper.make_node("Choose", [], [], branches=[graph, graph])
    assert scan(tiny_model(nodes=[node])).custom_operators == {"com.example::Run"}


def test_functions_of_the_file_s_own():
    model = tiny_model()
    function = helper.make_function("com.example", "Run", ["x"], ["y"], [helper.make_node("Relu", ["x"], ["y"])], [])
    model.functions.append(function)
    assert scan(model).custom_operators == {"a function of the file's own"}


def test_external_data_of_an_initializer():
    assert scan(tiny_model(initializers=[external(constant("w"))])).external_files == {"weights.bin"}


def test_external_data_that_calls_itself_internal():
    tensor = external(constant("w"), "/etc/passwd")
    tensor.data_location = TensorProto.DEFAULT
    assert scan(tiny_model(initializers=[tensor])).external_files == {"/etc/passwd"}


def test_external_data_that_names_no_file():
    tensor = constant("w")
    tensor.data_location = TensorProto.EXTERNAL
    assert scan(tiny_model(initializers=[tensor])).external_files == {""}


def test_external_data_of_a_constant():
    node = helper.make_node("Constant", [], ["c"], value=external(constant("w")))
    assert scan(tiny_model(nodes=[node])).external_files == {"weights.bin"}
    assert scan(tiny_model(nodes=[in_subgraph(node, 2)])).external_files == {"weights.bin"}


def test_external_data_of_a_list_of_tensors():
    node = helper.make_node("Constant", [], ["c"])
    node.attribute.append(helper.make_attribute("values", [constant("v"), external(constant("w"))]))
    assert scan(tiny_model(nodes=[node])).external_files == {"weights.bin"}


def test_external_data_of_a_subgraph_s_initializer():
    graph = helper.make_graph([], "inner", [], [], [external(constant("w"))])
    node = helper.make_node("If", ["c"], ["y"], then_branch=graph, else_branch=graph)
    assert scan(tiny_model(nodes=[node])).external_files == {"weights.bin"}


@pytest.mark.parametrize("part", ["values", "indices"])
def test_external_data_of_sparse_tensors(part):
    parts = {
        "values": numpy_helper.from_array(np.ones(1, np.float32), "s"),
        "indices": numpy_helper.from_array(np.zeros(1, np.int64), "i"),
    }
    external(parts[part])
    sparse = helper.make_sparse_tensor(parts["values"], parts["indices"], [4])
    assert scan(tiny_model(sparse=[sparse])).external_files == {"weights.bin"}
    node = helper.make_node("Constant", [], ["c"])
    node.attribute.append(helper.make_attribute("sparse_value", sparse))
    assert scan(tiny_model(nodes=[node])).external_files == {"weights.bin"}


def test_a_graph_in_two_pieces_is_read_as_one():
    """Protobuf joins a message that is written twice; what the second piece adds must not be overlooked."""
    more = onnx.ModelProto()
    more.graph.node.append(CUSTOM)
    more.graph.initializer.append(external(constant("w")))
    data = tiny_model().SerializeToString() + more.SerializeToString()
    assert onnx.load_from_string(data).graph.node[-1].domain == "com.example"
    contents = read_onnx(data)
    assert contents.custom_operators == {"com.example::Run"} and contents.external_files == {"weights.bin"}


def varint(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def message(number: int, content: bytes, key_bits: int = 0) -> bytes:
    return varint(number << 3 | 2 | key_bits) + varint(len(content)) + content


GOOD = tiny_model().SerializeToString()


@pytest.mark.parametrize("bits", [1 << 32, 1 << 34, 1 << 40, 1 << 63])
def test_a_field_is_not_hidden_behind_a_long_key(bits):
    """Some readers cut a key to 32 bits: to them this is another graph."""
    more = onnx.GraphProto()
    more.node.append(CUSTOM)
    with pytest.raises(ValueError, match="not an ONNX file"):
        read_onnx(GOOD + message(7, more.SerializeToString(), bits))


BAD = {
    "empty": b"",
    "text": b"this is not a model, whatever its name says\n" * 20,
    "zeros": bytes(1000),
    "ones": b"\xff" * 1000,
    "zip": b"PK\x03\x04" + bytes(100),
    "no graph": onnx.ModelProto(ir_version=8).SerializeToString(),
    "cut": GOOD[: len(GOOD) // 2],
    "cut by one": GOOD[:-1],
    "endless number": b"\x08" + b"\x80" * 1_000_000,
    "long message": GOOD + b"\x3a" + varint(2**62) + b"abc",
    "longest message": GOOD + b"\x3a" + b"\xff" * 9 + b"\x01" + b"abc",
    "cut key": GOOD + b"\x80",
    "cut double": GOOD + b"\x09abc",
    "group": GOOD + b"\x0b",
    "number for graph": GOOD + b"\x38\x05",
    "number for name": GOOD + message(14, b"\x08" + varint(2**62) + b"\x12\x00"),
    "number for property": GOOD + b"\x70" + varint(2**40),
    "number for node": GOOD + message(7, b"\x08\x01"),
    "number for domain": GOOD + message(7, message(1, b"\x38" + varint(2**61))),
    "number for shape": GOOD + message(7, message(11, b"\x10\x05")),
    "name that is no text": GOOD + message(7, message(11, message(1, b"\xff\xfe"))),
}


@pytest.mark.parametrize("data", BAD.values(), ids=BAD.keys())
def test_bytes_that_are_no_model(data):
    with pytest.raises(ValueError, match="not an ONNX file"):
        read_onnx(data)


@pytest.mark.parametrize("seed", range(8))
def test_random_damage_is_refused_or_read(seed):
    """Nothing but ValueError, whatever the bytes: flipped, cut out, doubled, overwritten."""
    rng = np.random.default_rng(seed)
    node = in_subgraph(helper.make_node("Constant", [], ["c"], value=constant("w")), 2)
    good = tiny_model(nodes=[node], metadata="{}").SerializeToString()
    refused = 0
    for _ in range(60):
        data = bytearray(good)
        for _ in range(rng.integers(1, 4)):
            place = int(rng.integers(len(data)))
            kind = rng.integers(4)
            if kind == 0:
                data[place] ^= 1 << int(rng.integers(8))
            elif kind == 1:
                data[place] = int(rng.integers(256))
            elif kind == 2:
                del data[place : place + int(rng.integers(1, 20))]
            else:
                data[place:place] = data[place : place + int(rng.integers(1, 20))]
        try:
            read_onnx(bytes(data))
        except ValueError:
            refused += 1
    assert 5 < refused < 60, "the damage is too small or too large to tell"


def test_every_truncation_is_refused():
    for end in range(len(GOOD)):
        with pytest.raises(ModelError):
            check_model(GOOD[:end], "m.onnx")
