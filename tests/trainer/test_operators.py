# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on accepts the operators, the sizes and the checksum of exported models."""

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
    """Models with each activation, with one and many joints, with deep and wide networks, and without components."""
    folder = tmp_path_factory.mktemp("models")
    for joints in (1, 12):
        write_chain(folder / f"chain_{joints}", pose_count=60, joint_count=joints)
    trainings = [(recording, "--activation", name, "--hidden", "24", "24") for name in ACTIVATIONS]
    trainings += [(folder / f"chain_{joints}", "--hidden", "16") for joints in (1, 12)]
    trainings += [(recording, "--hidden", "300", "200", "100", "50"), (recording, "--tolerance-mm", "10000")]
    contents = []
    for index, (path, *options) in enumerate(trainings):
        model = folder / f"{index}.onnx"
        assert main([str(path), str(model), "--epochs", "5", *options]) == 0
        contents.append(model.read_bytes())
    return contents


def test_the_add_on_accepts_every_exported_operator(models):
    exported_operators = {node.op_type for data in models for node in onnx.load_from_string(data).graph.node}
    assert exported_operators <= set(OPERATORS)
    assert {"MatMul", "Gather", "Erf", "Tanh", "Relu", "Sigmoid"} <= exported_operators


def test_the_limits_of_the_add_on_leave_a_margin(models):
    """If exported graphs come near the limits, the limits must be raised before they refuse a character."""
    for data in models:
        info, contents = check_model(data, "m.onnx"), read_onnx(data)
        budget, cost = info.budget(), compute_graph_cost(contents, 1)
        assert cost.elements < COST_FACTOR / 2 * (budget.values + FREE_ELEMENTS)
        assert sum(len(c.data) for c in contents.constants.values()) < 4 * COST_FACTOR / 2 * (
            budget.constants + FREE_ELEMENTS
        )


def test_changed_weights_are_refused(trained):
    data = bytearray((trained / "model.onnx").read_bytes())
    largest_constant = max(read_onnx(bytes(data)).constants.values(), key=lambda constant: len(constant.data)).data
    data[bytes(data).index(bytes(largest_constant)) + len(largest_constant) // 2] ^= 1
    with pytest.raises(ModelError, match="is damaged: its checksum is not that of its weights"):
        check_model(bytes(data), "m.onnx")


def test_a_graph_larger_than_its_metadata_explains_is_refused(trained):
    """The limits come from the metadata. A graph with more constants than its metadata explain is refused."""
    model = onnx.load_from_string((trained / "model.onnx").read_bytes())
    metadata_property = next(prop for prop in model.metadata_props if prop.key == METADATA_KEY)
    metadata = json.loads(metadata_property.value)
    added_constant = np.zeros((2000, 1000), np.float32)
    model.graph.initializer.append(onnx.numpy_helper.from_array(added_constant, "more"))
    metadata["training"]["hidden"] = [8]
    metadata_property.value = json.dumps(metadata)
    model.metadata_props.remove(next(prop for prop in model.metadata_props if prop.key == CHECKSUM_KEY))
    with pytest.raises(ModelError, match="more than its joints, vertices and components explain"):
        check_model(model.SerializeToString(), "m.onnx")
