# SPDX-License-Identifier: GPL-3.0-or-later
"""A face of bones, shape keys and correctives: learned from its controls, and played by an action it has not seen."""

import json
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import face
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.mesh import evaluated_positions

from .conftest import assert_plays, run, train

MOST = 0.5
"""Part of linear skinning's mean error that a short training may leave; docs/characters.md has a long one's."""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the rig, a recording and a model."""
    folder = tmp_path_factory.mktemp("face")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    face.face()
    face.add_speech()
    save_copy(folder / "face.blend")
    options = ("--poses", 200, "--spread", 10, "--control", "shape_keys")
    assert run("record", folder / "face.blend", folder / "recording", *options) == 0
    train(folder / "recording", folder / "face.onnx", "--epochs", 60)
    return folder


@pytest.fixture
def opened(files: Path) -> bpy.types.Object:
    bpy.ops.wm.open_mainfile(filepath=str(files / "face.blend"))
    return bpy.data.objects[face.MESH]


def test_half_of_its_controls_are_shape_keys(opened, files):
    keys = opened.data.shape_keys
    driven = {curve.data_path for curve in keys.animation_data.drivers}
    free = [block.name for block in keys.key_blocks[1:] if f'key_blocks["{block.name}"].value' not in driven]
    bones = bpy.data.objects[face.ARMATURE].pose.bones
    assert len(opened.data.vertices) >= 5000
    assert (len(free), len(bones), len(driven)) == (22, 22, 12)
    recording = read_recording(files / "recording")
    controls = {control.name for control in recording.rig.controls}
    assert controls == {f'shape_keys/key_blocks["{name}"].value' for name in free}


@pytest.mark.parametrize(("first", "second"), face._correctives(), ids="-".join)
def test_correctives_come_with_both(opened, first, second):
    """A corrective moves the mesh where both are there, and neither alone."""
    blocks, jaw = opened.data.shape_keys.key_blocks, bpy.data.objects[face.ARMATURE].pose.bones["jaw"]
    corrective = blocks[f"{first}_{second}"]

    def set_to(one: float, other: float) -> float:
        blocks[first].value = one
        if second == "jaw":
            jaw.rotation_euler[0] = -other * face.JAW_OPENS
        else:
            blocks[second].value = other
        bpy.context.view_layer.update()
        graph = bpy.context.evaluated_depsgraph_get()
        evaluated_positions(opened, graph)
        return opened.evaluated_get(graph).data.shape_keys.key_blocks[corrective.name].value

    assert [round(set_to(*values), 3) for values in ((0, 1), (1, 0), (1, 0.5), (1, 1))] == [0, 0, 0.5, 1]


def test_an_action_that_training_has_not_seen(files, tmp_path):
    report, speech = tmp_path / "errors.json", ("--action", face.SPEECH)
    assert run("evaluate", files / "face.blend", files / "face.onnx", "--json", report, "--poses", 0, *speech) == 0
    (errors,) = json.loads(report.read_text())["actions"]
    assert errors["linear"]["max"] > 5
    assert errors["fdda"]["mean"] < MOST * errors["linear"]["mean"]


def test_the_bound_face_speaks(files, tmp_path):
    bound = tmp_path / "bound.blend"
    assert run("bind", files / "face.blend", files / "face.onnx", bound) == 0
    bpy.ops.wm.open_mainfile(filepath=str(bound))
    mesh_object, armature_object = bpy.data.objects[face.MESH], bpy.data.objects[face.ARMATURE]
    armature_object.animation_data.action = bpy.data.actions[face.SPEECH]
    keys, seen = mesh_object.data.shape_keys, []
    for frame, smile in ((1, 0.0), (30, 0.7), (61, 1.0)):
        bpy.context.scene.frame_set(frame)
        keys.key_blocks["smile.L"].value = smile
        bpy.context.view_layer.update()
        seen.append(assert_plays(mesh_object, files / "face.onnx"))
    assert np.abs(seen[0] - seen[1]).max() > 0.003
