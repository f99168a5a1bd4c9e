# SPDX-License-Identifier: GPL-3.0-or-later
"""Verbs that refuse models of another rig and damaged model files with one error message."""

import bpy
import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from fdda_addon.runtime.binding import bind
from fdda_addon.scene.scene_rig import find_rig

from ... import systems
from ..conftest import write_edited
from ..refusals import save_elbow


@pytest.fixture(params=["bind", "evaluate", "benchmark"])
def verb(request, tmp_path):
    """Return, for each verb that reads a model, a function from the paths of rig and model to its arguments."""
    more_arguments = {
        "bind": [tmp_path / "bound.blend"],
        "evaluate": ["--json", tmp_path / "e.json", "--poses", "2"],
        "benchmark": ["--json", tmp_path / "b.json", "--frames", "5"],
    }[request.param]
    return lambda rig, model: [request.param, rig, model, *more_arguments]


def rename_bone(rig) -> None:
    rig.armature_object.data.bones["lower"].name = "forearm"


def test_a_model_of_another_rig_is_refused(refusal, verb, elbow_files, tmp_path):
    text = refusal(*verb(save_elbow(tmp_path / "rig.blend", rename_bone), elbow_files.model))
    words = "the armature lacks the joint 'lower'; it does not know the joint 'forearm'. Record and train this rig."
    assert text == f"The model '{elbow_files.model}' was trained for another rig: {words}"


def test_a_missing_model_is_refused(refusal, verb, elbow_files, tmp_path):
    path = tmp_path / "none.onnx"
    text = refusal(*verb(elbow_files.rig, path))
    assert text.startswith(f"The model '{path}' cannot be read: {systems.NOT_FOUND}; ")


def remove_metadata(model) -> None:
    del model.metadata_props[:]


def use_double_input(model) -> None:
    model.graph.input[0].type.tensor_type.elem_type = TensorProto.DOUBLE


@pytest.mark.parametrize(
    ("change", "start", "end"),
    [
        (remove_metadata, "The model '", " is an ONNX file but not a model of this add-on; give one that train made."),
        (use_double_input, "ONNX Runtime refuses the model '", "); train it again."),
    ],
)
def test_onnx_files_that_are_not_models_are_refused(refusal, verb, elbow_files, tmp_path, change, start, end):
    path = write_edited(elbow_files.model, tmp_path / "m.onnx", change)
    text = refusal(*verb(elbow_files.rig, path))
    assert text.startswith(start + str(path)) and text.endswith(end)


def output_nan(model) -> None:
    """Multiply the output positions by NaN."""
    last = next(node for node in model.graph.node if "positions" in node.output)
    last.output[list(last.output).index("positions")] = "good"
    model.graph.initializer.append(numpy_helper.from_array(np.float32([np.nan]), "nan"))
    model.graph.node.append(helper.make_node("Mul", ["good", "nan"], ["positions"]))


def test_evaluation_of_a_model_that_returns_nan_is_refused(refusal, elbow_files, tmp_path):
    path = write_edited(elbow_files.model, tmp_path / "m.onnx", output_nan)
    text = refusal("evaluate", elbow_files.rig, path, "--json", tmp_path / "e.json", "--poses", 2)
    assert f"The model '{path}' gives positions that are not numbers (held-out poses, pose 0)" in text


def output_nan_when_straight(model) -> None:
    """Add 0 / 0 to the positions if an element of the lower joint's matrix is above 0.85, as in a straight arm."""
    last = next(node for node in model.graph.node if "positions" in node.output)
    last.output[list(last.output).index("positions")] = "good"
    for name, value in (("from", [1, 0, 1]), ("to", [2, 1, 2]), ("axes", [1, 2, 3]), ("one", [-1, 1, 1])):
        model.graph.initializer.append(numpy_helper.from_array(np.array(value, np.int64), f"my_{name}"))
    model.graph.initializer.append(numpy_helper.from_array(np.float32([0]), "my_zero"))
    model.graph.initializer.append(numpy_helper.from_array(np.float32([0.85]), "my_limit"))
    for node in (
        ("Slice", ["pose_matrices", "my_from", "my_to", "my_axes"], ["my_element"]),
        ("Sub", ["my_limit", "my_element"], ["my_rest"]),
        ("Max", ["my_rest", "my_zero"], ["my_part"]),
        ("Div", ["my_part", "my_part"], ["my_one_or_none"]),
        ("Mul", ["my_one_or_none", "my_zero"], ["my_nothing"]),
        ("Reshape", ["my_nothing", "my_one"], ["my_column"]),
        ("Add", ["good", "my_column"], ["positions"]),
    ):
        model.graph.node.append(helper.make_node(*node))


@pytest.mark.parametrize("change", [output_nan, output_nan_when_straight])
def test_playing_a_model_that_returns_nan_shows_an_error(bound_elbow, elbow_files, tmp_path, change, capsys):
    armature = bpy.data.objects["elbow_rig"]
    armature.animation_data_clear()
    bind(find_rig(), write_edited(elbow_files.model, tmp_path / "m.onnx", change))
    is_error_shown = []
    for angle in (0.8, -0.8, 0.8):
        armature.pose.bones["lower"].rotation_euler[0] = angle
        bpy.context.view_layer.update()
        is_error_shown.append("gives positions that are not numbers; train it again." in bound_elbow.fdda.status)
    if change is output_nan:
        assert is_error_shown == [True, True, True]
    else:
        assert sorted(set(is_error_shown)) == [False, True]
    assert bound_elbow.fdda.mode == "FDDA"
