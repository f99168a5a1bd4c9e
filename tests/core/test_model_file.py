# SPDX-License-Identifier: GPL-3.0-or-later
"""The model file: its metadata comes back as it was, and what is no model of ours is refused in a sentence."""

import json
import os
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper

from fdda_addon.core.errors import ModelError
from fdda_addon.core.model import ModelInfo, ModelPartition, check_rig, read_model, read_model_info
from fdda_addon.core.poses import Channel

from .. import systems
from .limb import make_rig
from .tiny_model import constant, external, in_subgraph, tiny_info, tiny_model


def save(tmp_path, model) -> os.PathLike:
    path = tmp_path / "m.onnx"
    path.write_bytes(model if isinstance(model, bytes) else model.SerializeToString())
    return path


def refused(path, *words: str) -> None:
    with pytest.raises(ModelError) as error:
        read_model(path)
    text = str(error.value)
    for word in (str(path), *words):
        assert word in text
    assert text.endswith(".") and "\n" not in text


def test_metadata_comes_back_as_it_was(tmp_path):
    path = save(tmp_path, tiny_model())
    info, data = read_model(path)
    assert data == path.read_bytes()
    for field in fields(ModelInfo):
        np.testing.assert_array_equal(getattr(info, field.name), getattr(tiny_info(), field.name), field.name)
    assert read_model_info(path).to_json() == tiny_info().to_json()


def test_metadata_keys():
    """docs/formats.md lists them."""
    value = json.loads(tiny_info().to_json())
    assert list(value) == [
        "version",
        "joints",
        "rest_matrices",
        "vertices",
        "fingerprint",
        "partitions",
        "training_ranges",
        "held_out_mm",
        "parity_mm",
        "training",
    ]
    assert value["joints"][1] == {"name": "upper.L", "parent": 0}
    assert value["partitions"][1] == {"joint": 2, "influencing": [1, 2], "vertices": 3, "basis": 17}
    assert np.shape(value["rest_matrices"]) == (3, 16)
    assert np.shape(value["training_ranges"]["low"]) == np.shape(value["training_ranges"]["high"]) == (3, 12)


def test_what_a_frame_reads_comes_back_and_must_be_a_size(tmp_path):
    assert json.loads(tiny_info(constant_bytes=1234).to_json())["constant_bytes"] == 1234
    assert read_model_info(save(tmp_path, tiny_model(metadata(constant_bytes=1234)))).constant_bytes == 1234
    assert read_model_info(save(tmp_path, tiny_model())).constant_bytes == 0
    refused(save(tmp_path, tiny_model(metadata(constant_bytes=-1))), "its constants are said to take -1 bytes")


def test_metadata_without_numbers_is_not_written():
    with pytest.raises(ValueError, match="not JSON compliant"):
        tiny_info(parity_mm=float("nan")).to_json()


def test_no_file(tmp_path):
    refused(tmp_path / "none.onnx", f"cannot be read: {systems.NOT_FOUND}; give one that train made")


def test_a_folder(tmp_path):
    refused(tmp_path, "cannot be read: Is a directory")


@systems.devices
def test_a_device_that_never_ends():
    refused(Path("/dev/zero"), "cannot be read: it is not a regular file")


@pytest.mark.parametrize("data", [b"", b"blender", bytes(500)])
def test_a_file_that_is_no_model(tmp_path, data):
    refused(save(tmp_path, data), "is not a model: not an ONNX file; give an .onnx file that train made")


def test_an_onnx_file_that_is_no_model_of_ours(tmp_path):
    refused(save(tmp_path, tiny_model(metadata=None)), "is an ONNX file but not a model of this add-on")


def test_external_data(tmp_path):
    refused(save(tmp_path, tiny_model(initializers=[external(constant("w"))])), "keeps data in other files")


def test_custom_operators(tmp_path):
    node = in_subgraph(helper.make_node("Run", [], ["y"], domain="com.example"))
    refused(save(tmp_path, tiny_model(nodes=[node])), "uses custom operators (com.example::Run), which is refused")


def test_extra_inputs(tmp_path):
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", 2]) for name in ("time", "controls")]
    refused(save(tmp_path, tiny_model(inputs=inputs)), "asks for inputs that no rig gives (controls, time)")


def metadata(**changes) -> str:
    return json.dumps({**json.loads(tiny_info().to_json()), **changes})


def without(key: str) -> str:
    value = json.loads(tiny_info().to_json())
    del value[key]
    return json.dumps(value)


@pytest.mark.parametrize("key", json.loads(tiny_info().to_json()))
def test_metadata_lacks_a_key(tmp_path, key):
    refused(save(tmp_path, tiny_model(without(key))), f"cannot be used: its metadata lacks '{key}'; train it again")


@pytest.mark.parametrize("key", json.loads(tiny_info().to_json()))
@pytest.mark.parametrize("value", [None, "x", [[]], {"a": 1}, float("inf"), -7.5, 10**400])
def test_metadata_of_another_type(tmp_path, key, value):
    if (key == "training" and value == {"a": 1}) or (key == "held_out_mm" and value == {"a": 1}):
        pytest.skip("any settings and any figures will do")
    if key == "parity_mm" and value in (-7.5, float("inf")):
        pytest.skip("a number is a number")
    refused(save(tmp_path, tiny_model(metadata(**{key: value}))), "cannot be used: ", "train it again")


@pytest.mark.parametrize("version", [2, 0, "1"])
def test_another_version(tmp_path, version):
    path = save(tmp_path, tiny_model(metadata(version=version)))
    refused(path, f"cannot be used: it is of version {version!r} and this add-on reads version 1")


@pytest.mark.parametrize("text", [" ", "{", "[" * 100_000, "[]", "3", '"text"', "null"])
def test_metadata_that_is_none(tmp_path, text):
    refused(save(tmp_path, tiny_model(text)), "cannot be used: its metadata ")


PARTITION = {"joint": 0, "influencing": [], "vertices": 4, "basis": 1}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"joints": [{"name": "a", "parent": 0}]}, "a joint comes before its parent"),
        ({"joints": [{"name": "a", "parent": -2}]}, "a joint comes before its parent"),
        ({"partitions": [{**PARTITION, "joint": 3}]}, "none of its joints"),
        ({"partitions": [{**PARTITION, "influencing": [9]}]}, "none of its joints"),
        ({"vertices": 5}, "the partitions do not add up to the vertices"),
        (
            {"partitions": [{**PARTITION, "reassigned": [4]}]},
            "a reassigned vertex that is none of its vertices, or another's",
        ),
        (
            {"partitions": [{**PARTITION, "reassigned": [-1]}]},
            "a reassigned vertex that is none of its vertices, or another's",
        ),
        (
            {"partitions": [{**PARTITION, "reassigned": [1, 1]}]},
            "a reassigned vertex that is none of its vertices, or another's",
        ),
        ({"partitions": [{**PARTITION, "reassigned": 1}]}, "its metadata cannot be read"),
        ({"rest_matrices": [[float("nan")] * 16] * 3}, "its rest pose holds values that are not numbers"),
        ({"rest_matrices": [[0.0] * 16] * 2}, "cannot reshape"),
    ],
)
def test_metadata_that_contradicts_itself(tmp_path, changes, words):
    refused(save(tmp_path, tiny_model(metadata(**changes))), "cannot be used: ", words)


def test_graph_that_contradicts_the_metadata(tmp_path):
    two = replace(tiny_info(), partitions=(ModelPartition(0, (), 5, 0),), vertex_count=5)
    refused(save(tmp_path, tiny_model(two.to_json())), "its output 'positions'", "does not fit its 5 vertices")
    one = tiny_info(
        joints=tiny_info().joints[:1],
        partitions=(ModelPartition(0, (), 4, 0),),
        **{name: getattr(tiny_info(), name)[:1] for name in ("rest_matrices", "feature_low", "feature_high")},
    )
    refused(save(tmp_path, tiny_model(one.to_json())), "its input 'pose_matrices'", "does not fit its 1 joints")


def test_a_model_without_our_input_or_output(tmp_path):
    model = tiny_model()
    model.graph.output[0].name = "vertices"
    refused(save(tmp_path, model), "its output 'positions'")
    model = tiny_model()
    model.graph.input[0].name = "pose"
    refused(save(tmp_path, model), "asks for inputs that no rig gives (pose)")


def test_model_of_the_same_rig_and_of_another(tmp_path):
    rig = make_rig()
    info = tiny_info(joints=rig.joints, rest_matrices=rig.rest_matrices, vertex_count=40, fingerprint=rig.fingerprint)
    check_rig(tmp_path / "m.onnx", info, rig)
    with pytest.raises(ModelError) as error:
        check_rig(tmp_path / "m.onnx", replace(info, vertex_count=41), replace(rig, joints=rig.joints[:3]))
    assert str(error.value) == (
        f"The model '{tmp_path / 'm.onnx'}' was trained for another rig: it has 41 vertices, the mesh has 40; "
        "the armature lacks the joint 'thumb'. Record and train this rig."
    )


def test_the_range_of_motion_is_kept_and_may_be_missing():
    limits = (Channel("a", "rotation", 0, -0.5, 1.25),)
    info = tiny_info(training={"limits": [channel.to_json() for channel in limits]})
    assert ModelInfo.from_json(info.to_json()).limits == limits
    assert ModelInfo.from_json(tiny_info().to_json()).limits == ()


@pytest.mark.parametrize(
    "limits", [3, ["a"], [{"bone": "a"}], [{**Channel("a", "rotation", 0, 0, 1).to_json(), "low": "x"}]]
)
def test_a_range_of_motion_that_is_none(tmp_path, limits):
    training = {"limits": limits}
    refused(save(tmp_path, tiny_model(metadata(training=training))), "cannot be used: ", "train it again")
