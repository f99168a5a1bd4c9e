# SPDX-License-Identifier: GPL-3.0-or-later
"""What the exporter writes is what the add-on takes: operators, sizes, and the checksum."""

import json

import numpy as np
import onnx
import pytest

from fdda_addon.core.errors import ModelError
from fdda_addon.core.model import CHECKSUM_KEY, METADATA_KEY, check_model
from fdda_addon.core.model_graph import COST_FACTOR, FREE_ELEMENTS
from fdda_addon.core.onnx_cost import OPERATORS, compute_graph_cost
from fdda_addon.core.onnx_file import read_onnx
from trainer.__main__ import main
from trainer.config import ACTIVATIONS

from .chain import write_chain


@pytest.fixture(scope="module")
def models(recording, tmp_path_factory) -> list[bytes]:
    """A model of each activation, of one and of many joints, deep, wide and without shapes."""
    folder = tmp_path_factory.mktemp("models")
    for joints in (1, 12):
        write_chain(folder / f"chain_{joints}", poses=60, joints=joints)
    ways = [(recording, "--activation", name, "--hidden", "24", "24") for name in ACTIVATIONS]
    ways += [(folder / f"chain_{joints}", "--hidden", "16") for joints in (1, 12)]
    ways += [(recording, "--hidden", "300", "200", "100", "50"), (recording, "--tolerance-mm", "10000")]
    found = []
    for number, (path, *options) in enumerate(ways):
        model = folder / f"{number}.onnx"
        assert main([str(path), str(model), "--epochs", "2", *options]) == 0
        found.append(model.read_bytes())
    return found


def test_every_operator_that_is_written_is_taken(models):
    written = {node.op_type for data in models for node in onnx.load_from_string(data).graph.node}
    assert written <= set(OPERATORS)
    assert {"MatMul", "Gather", "Erf", "Tanh", "Relu", "Sigmoid"} <= written


def test_the_metadata_explains_the_size_with_room_to_spare(models):
    """An exporter that comes near the bounds is to widen them, before a character fails on them."""
    for data in models:
        info, contents = check_model(data, "m.onnx"), read_onnx(data)
        budget, cost = info.budget(), compute_graph_cost(contents, 1)
        assert cost.elements < COST_FACTOR / 2 * (budget.values + FREE_ELEMENTS)
        assert sum(len(c.data) for c in contents.constants.values()) < 4 * COST_FACTOR / 2 * (
            budget.constants + FREE_ELEMENTS
        )


def test_weights_that_were_changed_are_noticed(trained):
    data = bytearray((trained / "model.onnx").read_bytes())
    largest = max(read_onnx(bytes(data)).constants.values(), key=lambda constant: len(constant.data)).data
    data[bytes(data).index(bytes(largest)) + len(largest) // 2] ^= 1
    with pytest.raises(ModelError, match="is damaged: its checksum is not that of its weights"):
        check_model(bytes(data), "m.onnx")


def test_a_larger_character_is_explained_by_its_numbers(trained):
    """The bounds come from the metadata: with fewer vertices in it the same graph is too large."""
    model = onnx.load_from_string((trained / "model.onnx").read_bytes())
    text = next(prop for prop in model.metadata_props if prop.key == METADATA_KEY)
    value = json.loads(text.value)
    big = np.zeros((2000, 1000), np.float32)
    model.graph.initializer.append(onnx.numpy_helper.from_array(big, "more"))
    value["training"]["hidden"] = [8]
    text.value = json.dumps(value)
    model.metadata_props.remove(next(prop for prop in model.metadata_props if prop.key == CHECKSUM_KEY))
    with pytest.raises(ModelError, match="more than its joints, vertices and components explain"):
        check_model(model.SerializeToString(), "m.onnx")
