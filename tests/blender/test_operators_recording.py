# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators that record and delete a recording, without a window: settings, cancellation and refusals."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.jobs import job
from fdda_addon.scene.scene_rig import SceneRig

from .scene_state import assert_same_state, scene_state


def recorded_folder(tmp_path: Path) -> Path:
    return tmp_path / "elbow_recording"


def record(rig: SceneRig, poses: int = 20, **options) -> set[str]:
    rig.mesh_object.fdda.settings.poses = poses
    return bpy.ops.fdda.record(**options)


def test_a_recording_follows_the_settings_and_is_stored_beside_the_file(saved, tmp_path):
    settings = saved.mesh_object.fdda.settings
    settings.seed, settings.spread = 5, 0.75
    bpy.data.actions["elbow_wave"].fdda.record = True
    bpy.data.actions.new("of something else").fdda.record = True
    before = scene_state(saved)
    assert record(saved) == {"FINISHED"}
    assert_same_state(before, scene_state(saved))
    sampling = read_recording(recorded_folder(tmp_path)).info.sampling
    assert (sampling.seed, sampling.spread) == (5, 0.75)
    assert [(s.kind, s.poses, s.name) for s in sampling.sources] == [
        ("random", 20, "remix"),
        ("action", 30, "elbow_wave"),
        ("alone", 12, ""),
    ]
    assert (
        job.state_of("record").outcome
        == "Recorded 50 poses, and 12 to find what each bone and input moves, into 'elbow_recording'."
    )


def test_an_unsaved_file_is_refused_without_a_folder():
    bpy.ops.fdda.add_sample_arm(density="1")
    with pytest.raises(
        RuntimeError, match=r"Save the \.blend file first \(recordings are stored next to it\), or choose a Folder"
    ):
        bpy.ops.fdda.record()


def test_a_recording_is_stored_in_the_given_folder(saved, tmp_path):
    saved.mesh_object.fdda.settings.recording = "//deep/down"
    assert record(saved) == {"FINISHED"}
    assert read_index(tmp_path / "deep" / "down")["complete"] == 32
    assert record(saved, folder=str(tmp_path / "other")) == {"FINISHED"}
    assert read_index(tmp_path / "other")["complete"] == 32


def test_a_canceled_recording_keeps_its_poses_and_is_resumed(saved, tmp_path, monkeypatch):
    show = job.JobState.show

    def cancel(state, progress):
        show(state, progress)
        if progress.stage == "poses" and progress.done == 8:
            bpy.ops.fdda.cancel()

    before = scene_state(saved)
    with monkeypatch.context() as patch:
        patch.setattr(job.JobState, "show", cancel)
        assert record(saved) == {"CANCELLED"}
    assert_same_state(before, scene_state(saved))
    outcome = job.state_of("record").outcome
    complete = read_index(recorded_folder(tmp_path))["complete"]
    assert complete >= 8 and f"{complete} of 20 poses are kept" in outcome
    with pytest.raises(RuntimeError, match="holds a recording already"):
        record(saved)
    assert record(saved, resume=True) == {"FINISHED"}
    assert len(read_recording(recorded_folder(tmp_path)).positions) == 32


def test_deleting_a_recording_keeps_other_files(saved, tmp_path):
    with pytest.raises(RuntimeError, match="holds no recording; there is nothing to remove"):
        bpy.ops.fdda.delete_recording()
    record(saved)
    (recorded_folder(tmp_path) / "notes.txt").write_text("mine")
    assert bpy.ops.fdda.delete_recording() == {"FINISHED"}
    assert [path.name for path in recorded_folder(tmp_path).iterdir()] == ["notes.txt"]


def test_a_bound_character_is_recorded_with_its_rig(bound_elbow, elbow_files, tmp_path):
    bpy.context.view_layer.objects.active = bound_elbow
    assert bound_elbow.fdda.is_playing
    bound_elbow.fdda.settings.poses = 5
    assert bpy.ops.fdda.record(folder=str(tmp_path / "r")) == {"FINISHED"}
    first, again = (read_recording(path).positions[:5] for path in (elbow_files.recording, tmp_path / "r"))
    np.testing.assert_allclose(again, first, atol=1e-6)
    assert bound_elbow.fdda.is_playing
