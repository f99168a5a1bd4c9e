# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on accepts the operators, the sizes and the checksum of exported models."""

import math

import onnx
import pytest

from fdda_addon.core.errors import ModelError
from fdda_addon.core.formats.model import check_model
from fdda_addon.core.formats.onnx_file import FREE_ELEMENTS, infer_shapes, read_onnx
from trainer.__main__ import main
from trainer.config import ACTIVATION

from .chain import constant_names, write_chain


@pytest.fixture(scope="module")
def models(recording, tmp_path_factory) -> list[bytes]:
    """Models with each activation, with one and many joints, with deep and wide networks, and without components."""
    folder = tmp_path_factory.mktemp("models")
    for joints in (1, 12):
        write_chain(folder / f"chain_{joints}", pose_count=60, joint_count=joints)
    trainings = [(recording, "--activation", name, "--hidden", "24", "24") for name in ACTIVATION.choices]
    trainings += [(folder / f"chain_{joints}", "--hidden", "16") for joints in (1, 12)]
    trainings += [(recording, "--hidden", "300", "200", "100", "50"), (recording, "--detail-mm", "10000")]
    contents = []
    for index, (path, *options) in enumerate(trainings):
        model = folder / f"{index}.onnx"
        assert main([str(path), str(model), "--passes", "5", *options]) == 0
        contents.append(model.read_bytes())
    return contents


def test_the_add_on_accepts_every_exported_model_with_a_margin(models):
    """If the values of exported graphs come near the limit, it must be raised before it refuses a character."""
    operators = {node.op_type for data in models for node in onnx.load_from_string(data).graph.node}
    assert {"MatMul", "Gather", "Erf", "Tanh", "Relu", "Sigmoid"} <= operators
    for data in models:
        check_model(data, "m.onnx")
        contents = read_onnx(data)
        shapes = infer_shapes(contents, {name: (1, *shape[1:]) for name, shape in contents.inputs.items()}, 1)
        loaded = constant_names(onnx.load_from_string(data).graph)
        once = sum(math.prod(shapes[name]) for name in loaded - contents.constants.keys())
        per_pose = sum(math.prod(shape) for name, shape in shapes.items() if name not in loaded)
        assert max(once / 3, per_pose) < (len(data) + FREE_ELEMENTS) / 4


def test_changed_weights_are_refused(trained):
    data = bytearray((trained / "model.onnx").read_bytes())
    largest_constant = max(read_onnx(bytes(data)).constants.values(), key=lambda constant: len(constant.data)).data
    data[bytes(data).index(bytes(largest_constant)) + len(largest_constant) // 2] ^= 1
    with pytest.raises(ModelError, match="is damaged: its checksum is not that of its weights"):
        check_model(bytes(data), "m.onnx")
