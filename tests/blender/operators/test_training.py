# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators that train and refine, without a window: settings, learning curves, cancellation and refusals."""

import json
from pathlib import Path

import bpy
import pytest

from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.recording.lock import LOCK_NAME
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.jobs import job
from fdda_addon.models.former_model import keep_former_model
from fdda_addon.panels import checks
from fdda_addon.properties.character import model_file
from fdda_addon.runtime.model_files import model_path
from fdda_addon.scene.scene_rig import SceneRig

from .. import conftest
from ..drawing import texts_of
from ..panels.test_sidebar import draw_section
from ..scene_state import assert_same_state, scene_state


def recorded_folder(tmp_path: Path) -> Path:
    return tmp_path / "elbow_recording"


def train(rig: SceneRig, elbow_files, **options) -> set[str]:
    settings = rig.mesh_object.fdda.settings
    settings.passes, settings.detail_mm, settings.training_seed = 6, 0.2, 3
    return bpy.ops.fdda.train(recording=str(elbow_files.recording), **options)


def test_what_a_training_replaces_is_kept_also_if_it_is_no_model_or_of_another_rig(elbow_files, tmp_path):
    model, previous = tmp_path / "a.onnx", tmp_path / "previous"
    for content, names in (
        (b"of another program", ["a.onnx"]),
        (elbow_files.model.read_bytes(), ["a-1.onnx", "a.onnx"]),
        (elbow_files.model.read_bytes(), ["a-1.onnx", "a.onnx"]),
    ):
        model.write_bytes(content)
        keep_former_model(model)
        assert sorted(path.name for path in previous.iterdir()) == names
        assert (previous / "a.onnx").read_bytes() == content
    assert (previous / "a-1.onnx").read_bytes() == b"of another program"


def test_a_model_is_trained_with_the_settings_and_kept_when_it_is_trained_again(saved, elbow_files, tmp_path):
    mesh_object = saved.mesh_object
    mesh_object.fdda.settings.model = "//models/a.onnx"
    assert train(saved, elbow_files) == {"FINISHED"}
    model = tmp_path / "models" / "a.onnx"
    training = read_model_info(model).training
    assert (training["passes"], training["detail_mm"], training["seed"]) == (6, 0.2, 3)
    state = job.state_of("train")
    assert (state.done, state.total) == (6, 6) and state.outcome.startswith("Trained 'a.onnx' in ")
    assert [len(state.curves[name]) for name in ("training", "validation")] == [6, 6]
    assert state.curves["validation"][-1] < state.curves["validation"][0]
    bpy.context.view_layer.objects.active = mesh_object
    checks.check_now(saved)
    texts = texts_of(draw_section("training"))
    assert any(", unseen poses: " in text for text in texts)
    assert len(texts) > texts.index("Bind a") > texts.index("Train Again")
    former_files = {name: (model.parent / name).read_bytes() for name in ("a.onnx", "report.json", "report.html")}
    assert not (model.parent / "previous").exists() and [m.name for m in mesh_object.fdda.models] == ["a"]
    mesh_object.fdda.settings.training_seed = 4
    assert bpy.ops.fdda.train(recording=str(elbow_files.recording)) == {"FINISHED"}
    assert {path.name: path.read_bytes() for path in (model.parent / "previous").iterdir()} == former_files
    assert model.read_bytes() != former_files["a.onnx"]
    models = mesh_object.fdda.models
    assert [entry.name for entry in models] == ["a", "a (previous)"] and models[
        mesh_object.fdda.model_index
    ].name == "a"
    mesh_object.fdda.model_index = 1
    assert bpy.ops.fdda.bind() == {"FINISHED"}
    assert model_path(mesh_object) == model.parent / "previous" / "a.onnx"


def test_a_canceled_training_writes_no_model(saved, elbow_files, tmp_path, monkeypatch):
    show = job.JobState.show

    def cancel(state, progress):
        show(state, progress)
        if progress.done == 2:
            bpy.ops.fdda.cancel()

    monkeypatch.setattr(job.JobState, "show", cancel)
    saved.mesh_object.fdda.settings.passes = 10_000
    options = {"recording": str(elbow_files.recording), "model": str(tmp_path / "m.onnx")}
    assert bpy.ops.fdda.train(**options) == {"CANCELLED"}
    assert job.state_of("train").outcome == "Training canceled; no model was written."
    assert not (tmp_path / "m.onnx").exists()


def test_refining_adds_poses_and_training_continues_from_the_checkpoint(saved, elbow_files, tmp_path):
    settings = saved.mesh_object.fdda.settings
    settings.poses, settings.passes, settings.use_goal, settings.goal_mm = 20, 2, True, 0.001
    assert bpy.ops.fdda.record() == {"FINISHED"}
    with pytest.raises(RuntimeError, match="There is no checkpoint"):
        bpy.ops.fdda.train(warm_start=True)
    conftest.train(recorded_folder(tmp_path), model_file(saved.mesh_object), "--passes", 2)
    before = scene_state(saved)
    assert bpy.ops.fdda.refine(poses=6) == {"FINISHED"}
    assert job.state_of("refine").outcome == "Added 6 poses to 'elbow_recording'; press Continue Training."
    assert_same_state(before, scene_state(saved))
    assert [s.kind for s in read_recording(recorded_folder(tmp_path)).info.sampling.sources] == [
        "random",
        "alone",
        "refined",
    ]
    assert not (recorded_folder(tmp_path) / LOCK_NAME).exists()
    assert bpy.ops.fdda.train(warm_start=True) == {"FINISHED"}
    model = model_file(saved.mesh_object)
    assert read_model_info(model).training["warm_start"]
    report = json.loads((model.parent / "report.json").read_text())
    assert report["poses"] == 26 and report["goal"]["verdict"] == "missed"


def test_refining_without_a_model_is_refused(saved):
    saved.mesh_object.fdda.settings.poses = 12
    bpy.ops.fdda.record()
    with pytest.raises(RuntimeError, match="train it first"):
        bpy.ops.fdda.refine()


def test_a_missing_or_incomplete_recording_is_refused(saved, tmp_path):
    with pytest.raises(RuntimeError, match="is not a recording: it has no recording"):
        bpy.ops.fdda.train()
    saved.mesh_object.fdda.settings.poses = 4
    bpy.ops.fdda.record()
    index = recorded_folder(tmp_path) / "recording.json"
    index.write_text(index.read_text().replace('"complete": 16', '"complete": 15'))
    with pytest.raises(RuntimeError, match="The recording 'elbow_recording' has 15 of 16 poses; resume it first"):
        bpy.ops.fdda.train()
