# SPDX-License-Identifier: GPL-3.0-or-later
"""Models, their metadata and skin weights, and untrained models: read back unchanged, and refused where damaged."""

import base64
import json
import os
from dataclasses import fields, replace

import numpy as np
import onnxruntime
import pytest
from onnx import TensorProto, helper

from fdda_addon.core.controls import Control
from fdda_addon.core.errors import ModelError
from fdda_addon.core.formats.model import (
    CONTROLS_INPUT,
    POSE_INPUT,
    POSITIONS_OUTPUT,
    SKIN_KEY,
    check_model,
    check_rig,
    read_model,
    read_model_info,
    read_skin,
)
from fdda_addon.core.formats.model_info import LIMITS_KEY, ModelInfo, ModelPartition
from fdda_addon.core.formats.untrained_model import build_untrained_model
from fdda_addon.core.mathematics.poses import CONTROL, Channel
from fdda_addon.core.mathematics.skin_fit import FitReport, SkinFit, skin_to_text
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.rig import STATIC_JOINT, Fingerprint, Joint, MeshPart

from ... import systems
from ..limb import make_rig, random_poses
from ..tiny_model import VERTEX_COUNT, tiny_info, tiny_model


def save_model(tmp_path, model) -> os.PathLike:
    """Write a model, or bytes, to m.onnx and return its path."""
    path = tmp_path / "m.onnx"
    path.write_bytes(model if isinstance(model, bytes) else model.SerializeToString())
    return path


def assert_refused(path, *phrases: str) -> None:
    """Check that reading the model fails with one sentence that contains its path and all phrases."""
    with pytest.raises(ModelError) as error:
        read_model(path)
    text = str(error.value)
    for phrase in (str(path), *phrases):
        assert phrase in text
    assert text.endswith(".") and "\n" not in text


def test_metadata_is_read_back_unchanged(tmp_path):
    path = save_model(tmp_path, tiny_model())
    info, data = read_model(path)
    assert data == path.read_bytes()
    for field in fields(ModelInfo):
        np.testing.assert_array_equal(getattr(info, field.name), getattr(tiny_info(), field.name), field.name)
    assert read_model_info(path).to_json() == tiny_info().to_json()


def test_non_finite_metadata_is_not_written():
    with pytest.raises(ValueError, match="not JSON compliant"):
        tiny_info(parity_mm=float("nan")).to_json()


def test_a_missing_file_is_refused(tmp_path):
    assert_refused(tmp_path / "none.onnx", f"cannot be read: {systems.NOT_FOUND}; give one that train made")


@pytest.mark.parametrize("data", [b"", b"blender", bytes(500)])
def test_a_file_of_another_kind_is_refused(tmp_path, data):
    assert_refused(save_model(tmp_path, data), "is refused: it is not an ONNX file; give one that train made")


def test_an_onnx_file_without_metadata_is_refused(tmp_path):
    assert_refused(save_model(tmp_path, tiny_model(metadata=None)), "is an ONNX file but not a model of this add-on")


def test_unknown_inputs_are_refused(tmp_path):
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", 2]) for name in ("time", "controls")]
    assert_refused(
        save_model(tmp_path, tiny_model(inputs=inputs)),
        "'time': (2,), 'controls': (2,)}, not {'pose_matrices': (3, 4, 4)}",
    )


def changed_metadata(**changes) -> str:
    """Return the metadata of the tiny model as JSON, with changed keys."""
    return json.dumps({**json.loads(tiny_info().to_json()), **changes})


@pytest.mark.parametrize("key", json.loads(tiny_info().to_json()))
@pytest.mark.parametrize("value", [None, "x", [[]], {"a": 1}, float("inf"), -7.5])
def test_metadata_of_a_wrong_type_is_refused(tmp_path, key, value):
    if (key in ("training", "held_out_mm") and value == {"a": 1}) or (key == "parity_mm" and value == -7.5):
        return
    assert_refused(
        save_model(tmp_path, tiny_model(changed_metadata(**{key: value}))), "cannot be used: ", "train it again"
    )


@pytest.mark.parametrize("version", [2, 0, "1"])
def test_another_version_is_refused(tmp_path, version):
    path = save_model(tmp_path, tiny_model(changed_metadata(version=version)))
    assert_refused(path, f"cannot be used: it is of version {version!r} and this add-on reads version 1")


@pytest.mark.parametrize("text", [" ", "{", "[" * 100_000, "[]", "3", '"text"', "null"])
def test_invalid_metadata_text_is_refused(tmp_path, text):
    assert_refused(save_model(tmp_path, tiny_model(text)), "cannot be used: its metadata ")


MESH_JSON = tiny_info().meshes[0].to_json()

PARTITION_JSON = {"joint": 0, "influencing": [], "vertices": 4, "basis": 1}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"joints": [{"name": "a", "parent": 0}]}, "a joint comes before its parent"),
        ({"partitions": [{**PARTITION_JSON, "influencing": [9]}]}, "partitions[0].influencing[0] is 9"),
        ({"partitions": [{**PARTITION_JSON, "controls": [0]}]}, "partitions[0].controls[0] is 0"),
        ({"training": {"limits": [{"bone": "a"}]}}, "its range of motion lacks"),
        ({"metres_per_unit": 0}, "metres_per_unit is 0"),
        ({"meshes": [{**MESH_JSON, "vertices": 5}]}, "the partitions do not add up to the vertices"),
        ({"rest_matrices": [[0.0] * 16] * 2}, "cannot reshape"),
        ({"rest_matrices": [[1e39] * 16] * 3}, "rest_matrices[0][0] is 1e+39"),
    ],
)
def test_inconsistent_metadata_is_refused(tmp_path, changes, words):
    assert_refused(save_model(tmp_path, tiny_model(changed_metadata(**changes))), "cannot be used: ", words)


def test_a_graph_that_contradicts_the_metadata_is_refused(tmp_path):
    info_of_five_vertices = replace(tiny_info(), partitions=(ModelPartition(0, (), 5, 0),))
    info_of_five_vertices = replace(info_of_five_vertices, meshes=(replace(tiny_info().meshes[0], vertices=5),))
    assert_refused(
        save_model(tmp_path, tiny_model(info_of_five_vertices.to_json())),
        "its output 'positions'",
        "comes out as (1, 4, 3), not as (1, 5, 3)",
    )
    info_of_one_joint = tiny_info(
        joints=tiny_info().joints[:1],
        partitions=(ModelPartition(0, (), 4, 0),),
        **{name: getattr(tiny_info(), name)[:1] for name in ("rest_matrices", "feature_low", "feature_high")},
    )
    assert_refused(
        save_model(tmp_path, tiny_model(info_of_one_joint.to_json())),
        "it takes the inputs",
        "not {'pose_matrices': (1, 4, 4)}",
    )


def test_other_names_of_input_and_output_are_refused(tmp_path):
    model = tiny_model()
    model.graph.output[0].name = "vertices"
    assert_refused(save_model(tmp_path, model), "it has no output 'positions'")
    model = tiny_model()
    model.graph.input[0].name = "pose"
    assert_refused(save_model(tmp_path, model), "it takes the inputs {'pose': ")


def test_a_model_of_another_rig_is_refused(tmp_path):
    rig = make_rig()
    info = tiny_info(joints=rig.joints, rest_matrices=rig.rest_matrices, meshes=rig.meshes)
    check_rig(tmp_path / "m.onnx", info, rig)
    with pytest.raises(ModelError) as error:
        check_rig(
            tmp_path / "m.onnx",
            replace(info, meshes=(replace(rig.meshes[0], vertices=41),)),
            replace(rig, joints=rig.joints[:3]),
        )
    assert str(error.value) == (
        f"The model '{tmp_path / 'm.onnx'}' was trained for another rig: it has 41 vertices, the mesh has 40; "
        "the armature lacks the joint 'thumb'. Record and train this rig."
    )


def test_limits_are_read_and_may_be_missing():
    limits = (Channel("a", "rotation", 0, -0.5, 1.25),)
    info = tiny_info(training={"limits": [channel.to_json() for channel in limits]})
    assert ModelInfo.from_json(info.to_json()).limits == limits
    assert ModelInfo.from_json(tiny_info().to_json()).limits == ()


@pytest.mark.parametrize("name", ["body", "shirt"])
def test_metadata_for_one_mesh_have_its_space_unit_and_controls(name):
    """The shirt is twice as large as the body, which comes first."""
    transform = tuple(np.diag([2.0, 2.0, 2.0, 1.0]).ravel().tolist())
    prints = Fingerprint("a", "b", "c"), Fingerprint("d", "e", "f")
    meshes = MeshPart("body", 3, prints[0]), MeshPart("shirt", 1, prints[1], transform)
    names = {"body": ("shape_keys", "shape_keys:shirt"), "shirt": ("shape_keys:body", "shape_keys")}
    paths = [f'{owner}/key_blocks["puff"].value' for owner in names["body"]]
    info = tiny_info(
        joints=(Joint("root", -1), Joint("arm", 0), Joint(STATIC_JOINT, -1)),
        rest_matrices=np.array([np.eye(4)] * 3, np.float32),
        meshes=meshes,
        controls=tuple(Control(*path.split("/"), 0.0, 1.0) for path in paths),
        training={LIMITS_KEY: [Channel(path, CONTROL, 0, 0.0, 1.0).to_json() for path in paths]},
    )
    own = info.of_mesh(meshes[name == "shirt"])
    scale = 2.0 if name == "shirt" else 1.0
    assert own.meshes == (MeshPart(name, meshes[name == "shirt"].vertices, prints[name == "shirt"]),)
    assert own.rest_matrices[:, 0, 0].tolist() == [1 / scale, 1 / scale, 1.0], "the static joint is the identity"
    assert own.metres_per_unit == pytest.approx(scale)
    assert tuple(control.owner for control in own.controls) == names[name]
    assert tuple(channel.name.split("/")[0] for channel in own.limits) == names[name]


KEYS = tuple(Control("shape_keys", f'key_blocks["key {index}"].value', 0.0, 1.0) for index in range(40))


@pytest.mark.parametrize("controls", [(), (Control("armature_object", '["fist"]', 0.0, 1.0), *KEYS)])
def test_an_untrained_model_is_linear_skinning(controls):
    rig = replace(make_rig(), controls=controls)
    distances = {control.name: np.ones(rig.vertex_count) for control in KEYS}
    data = build_untrained_model(rig, distances)
    info = check_model(data, "untrained")
    assert info.meshes == rig.meshes and info.controls == controls
    poses = random_poses(5).astype(np.float32)
    inputs = {POSE_INPUT: poses}
    if controls:
        inputs[CONTROLS_INPUT] = np.ones((len(poses), len(controls)), np.float32)
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    (positions,) = session.run([POSITIONS_OUTPUT], inputs)
    np.testing.assert_allclose(positions, LinearSkinning(rig).positions(poses), atol=1e-5)


def test_a_mesh_without_weights_follows_the_nearest_joints():
    rig = make_rig()
    unweighted = replace(rig, skin_weights=np.zeros_like(rig.skin_weights))
    info = check_model(build_untrained_model(unweighted, {}), "untrained")
    assert len(info.partitions) > 1 and sum(partition.vertices for partition in info.partitions) == rig.vertex_count


FIT = SkinFit(
    "smooth",
    25,
    FitReport({"rig": 4.25, "fitted": 1.5}, {"rig": 40.0, "fitted": 21.25}),
    FitReport({"rig": 4.0, "fitted": 1.25}, {"rig": 39.0, "fitted": 20.0}),
)

SKIN_JOINTS = np.array([[0, 2, 0, 0], [1, 0, 0, 0], [2, 1, 0, 0], [0, 1, 2, 0]], np.int32)

SKIN_WEIGHTS = np.array([[0.75, 0.25, 0, 0], [1, 0, 0, 0], [0.5, 0.5, 0, 0], [0.5, 0.3, 0.2, 0]], np.float32)


def test_sentence_about_a_fit():
    assert FIT.sentence() == (
        "Linear skinning with fitted weights (smooth), mm: 1.50 rms and 21.2 max on 12 held-out poses, 4.25 rms and "
        "40.0 max with the rig's own weights; 1.25 rms and 20.0 max on the 13 poses of the fit, 4.00 rms and 39.0 max "
        "with the rig's own."
    )


def test_a_fit_is_read_back_from_json_and_a_damaged_one_refused():
    assert SkinFit.from_json(json.loads(json.dumps(FIT.to_json()))) == FIT
    with pytest.raises(ValueError, match=r"fit\.training is None"):
        SkinFit.from_json({**FIT.to_json(), "training": None})


def changed_skin_text(**changes) -> str:
    """Return the text of the skin weights with changed JSON keys."""
    return json.dumps({**json.loads(skin_to_text(SKIN_JOINTS, SKIN_WEIGHTS)), **changes})


def base64_of_array(array: np.ndarray) -> str:
    """Encode the bytes of an array as the metadata of a model does."""
    return base64.b64encode(array.tobytes()).decode()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 100_000, "its skin weights cannot be read"),
        ("{}", "its skin weights cannot be read ('influences')"),
        (changed_skin_text(influences=10**9), "they have 1000000000 joints per vertex"),
        (changed_skin_text(weights="AAAA"), f"they are not for {VERTEX_COUNT} vertices"),
        (changed_skin_text(joints=base64_of_array(SKIN_JOINTS + 1)), "its skin weights are no weights of its joints"),
        (changed_skin_text(weights=base64_of_array(SKIN_WEIGHTS * 2)), "its skin weights are no weights of its joints"),
    ],
)
def test_damaged_weights_of_a_model_are_refused(tmp_path, text, words):
    model = tiny_model()
    model.metadata_props.add(key=SKIN_KEY, value=text)
    path = tmp_path / "m.onnx"
    path.write_bytes(model.SerializeToString())
    info, data = read_model(path)
    with pytest.raises(ModelError) as error:
        read_skin(data, info, path)
    assert str(error.value).startswith(f"The model '{path}' cannot be used: its skin weights ")
    assert words in str(error.value) and str(error.value).endswith("; train it again.")


def test_skin_weights_are_read_from_a_model():
    model = tiny_model()
    assert read_skin(model.SerializeToString(), tiny_info(), "m") is None
    model.metadata_props.add(key=SKIN_KEY, value=skin_to_text(SKIN_JOINTS, SKIN_WEIGHTS))
    joints, weights = read_skin(model.SerializeToString(), tiny_info(), "m")
    assert (joints == SKIN_JOINTS).all() and (weights == SKIN_WEIGHTS).all()
