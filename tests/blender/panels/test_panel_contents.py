# SPDX-License-Identifier: GPL-3.0-or-later
"""The content of the sections from Rig to Training, computed without a window."""

import json
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from fdda_addon.core.recording.folder import FolderState
from fdda_addon.jobs import job
from fdda_addon.jobs.job import JobRunner
from fdda_addon.jobs.state import JobState, format_duration
from fdda_addon.panels import checks, curves
from fdda_addon.panels.recording import cached_content
from fdda_addon.panels.section import panel_rig
from fdda_addon.panels.timed_value import TimedValues
from fdda_addon.panels.training import _read_report
from fdda_addon.properties.character import model_file, recording_folder
from fdda_addon.recording.rig_check import RigCheck
from fdda_addon.rig.dependencies import read_dependencies
from fdda_addon.scene import draw_cache
from fdda_addon.scene.scene_rig import SceneRig
from fdda_addon.timing.benchmark import Benchmark, MeshTimes

from ..conftest import ELBOW
from ..scene_state import fresh_elbow


@pytest.fixture
def fresh() -> SceneRig:
    rig = fresh_elbow()
    bpy.context.view_layer.objects.active = rig.mesh_object
    return rig


class TestChecks:
    def test_a_valid_rig_has_no_problems(self, fresh):
        assert checks.last_check(fresh) is None, "nothing is checked while drawing"
        check = checks.check_now(fresh)
        assert check.problems == () and check.rig.joint_names == ("upper", "lower") and len(check.channels) == 4
        assert checks.last_check(fresh) is check

    def test_all_problems_are_listed_with_the_messages_of_the_command_line(self, fresh):
        fresh.armature_object.data.pose_position = "REST"
        for bone in fresh.armature_object.pose.bones:
            bone.lock_rotation = (True, True, True)
        problems = checks.check_now(fresh).problems
        assert problems[0] == "The armature 'elbow_rig' shows its rest position; set it to pose."
        assert problems[1].startswith("No bone of 'elbow_rig' may be sampled: all 2 are locked")
        assert len(problems) == 2

    def test_a_change_of_the_mesh_reads_it_again_and_a_pose_does_not(self, fresh):
        first = checks.check_now(fresh)
        fresh.armature_object.pose.bones["lower"].rotation_euler[0] = 0.5
        bpy.context.view_layer.update()
        assert checks.check_now(fresh).rig is first.rig
        fresh.armature_object.pose.bones["lower"].lock_rotation[0] = True
        bpy.context.view_layer.update()
        again = checks.check_now(fresh)
        assert again.rig is first.rig and len(again.channels) == 3
        fresh.mesh_object.data.vertices[0].co.x += 0.01
        fresh.mesh_object.data.update()
        bpy.context.view_layer.update()
        moved = checks.check_now(fresh)
        assert moved.rig is not first.rig
        assert moved.rig.meshes[0].fingerprint.rest_positions != first.rig.meshes[0].fingerprint.rest_positions

    def test_a_change_of_the_rest_pose_reads_it_again(self, fresh):
        first = checks.check_now(fresh)
        bpy.context.view_layer.objects.active = fresh.armature_object
        bpy.ops.object.mode_set(mode="EDIT")
        fresh.armature_object.data.edit_bones["lower"].roll += 0.3
        bpy.ops.object.mode_set(mode="OBJECT")
        again = checks.check_now(fresh)
        assert np.abs(again.rig.rest_matrices[1] - first.rig.rest_matrices[1]).max() > 0.1

    def test_a_rig_without_a_joint_to_sample_can_be_recorded_by_its_actions(self, fresh):
        for bone in fresh.armature_object.pose.bones:
            bone.lock_rotation = (True, True, True)
        assert checks.check_now(fresh).problems[0].startswith("No bone of 'elbow_rig' may be sampled")
        fresh.mesh_object.fdda.settings.poses = 0
        check = checks.check_now(fresh)
        assert check.problems == () and check.rig is not None and check.channels == ()

    def test_a_playing_model_is_no_problem(self, bound_elbow):
        bpy.context.view_layer.objects.active = bound_elbow
        rig, sentence = panel_rig(bpy.context)
        assert bound_elbow.fdda.is_playing and sentence == ""
        # The driver of the model reads bones and the strength; these are no inputs of the rig.
        assert not read_dependencies(rig).controls and not read_dependencies(rig).bones
        assert checks.check_now(rig).problems == ()

    def test_a_missing_rig_is_a_message_and_not_an_exception(self):
        assert panel_rig(bpy.context) == (
            None,
            "Nothing with a rig is active; select the mesh of a character, or its armature.",
        )


class TestFolder:
    @pytest.fixture
    def saved(self, rig: SceneRig, tmp_path: Path) -> SceneRig:
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "elbow.blend"))
        bpy.context.view_layer.objects.active = rig.mesh_object
        rig.mesh_object.fdda.settings.poses = 5
        return rig

    def look(self, rig: SceneRig) -> FolderState:
        checks.check_now(rig)
        return cached_content(rig, recording_folder(rig.mesh_object)).state

    def test_what_the_section_says_follows_folder_settings_and_rig(self, saved):
        assert self.look(saved) is FolderState.FREE
        bpy.ops.fdda.record()
        assert self.look(saved) is FolderState.COMPLETE
        index = recording_folder(saved.mesh_object) / "recording.json"
        values = json.loads(index.read_text())
        index.write_text(json.dumps(values | {"complete": 3}))
        assert self.look(saved) is FolderState.INCOMPLETE
        saved.mesh_object.fdda.settings.seed = 1
        assert self.look(saved) is FolderState.OTHER
        saved.mesh_object.fdda.settings.seed = 0
        bpy.data.actions["elbow_wave"].fdda.record = True
        assert self.look(saved) is FolderState.OTHER
        bpy.data.actions["elbow_wave"].fdda.record = False
        assert self.look(saved) is FolderState.INCOMPLETE
        bpy.ops.fdda.set_limits(bone="upper", axes=(True, False, False), low=(-1,) * 3, high=(1,) * 3)
        assert self.look(saved) is FolderState.OTHER

    def test_the_settings_belong_to_the_character_and_are_saved(self, saved, tmp_path):
        settings = saved.mesh_object.fdda.settings
        settings.seed, settings.recording, settings.detail_mm = 4, "//takes/one", 0.25
        bpy.data.actions["elbow_wave"].fdda.record = True
        bpy.ops.wm.save_mainfile()
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "elbow.blend"))
        mesh_object = bpy.data.objects[ELBOW]
        settings = mesh_object.fdda.settings
        assert (settings.poses, settings.seed, settings.detail_mm) == (5, 4, 0.25)
        assert recording_folder(mesh_object) == tmp_path / "takes" / "one"
        assert model_file(mesh_object) == tmp_path / "elbow_model" / "elbow.onnx"
        # Another file of the folder has a mesh of this name too.
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "hero.blend"))
        settings.recording = ""
        assert recording_folder(mesh_object) == tmp_path / "hero_elbow_recording"
        assert model_file(mesh_object) == tmp_path / "hero_elbow_model" / "hero_elbow.onnx"
        assert bpy.data.actions["elbow_wave"].fdda.record


class TestTraining:
    def test_learning_curves_are_drawn_in_their_colors(self):
        falling = {"training": [1.0, 0.1, 0.01], "validation": [2.0, 0.2, 0.02]}
        pixels = curves.paint(falling)
        assert pixels.shape == (curves.HEIGHT, curves.WIDTH, 4) and pixels.dtype == np.float32
        assert pixels.min() >= 0 and pixels.max() <= 1
        heights = {}
        pixels = pixels[curves.MARGIN_BOTTOM :, curves.MARGIN_LEFT :]
        for name, (_, _, color) in curves.LEGEND.items():
            distance = np.abs(pixels[..., :3] - np.float32(color)).sum(axis=-1)
            heights[name] = distance.argmin(axis=0)
            assert distance.min(axis=0).max() < 0.05, "a line without gaps"
        for falls in heights.values():
            assert falls[0] > falls[len(falls) // 2] > falls[-1]
        assert (heights["validation"] > heights["training"]).all()

    @pytest.mark.parametrize("values", [[0.0, 0.0], [0.5, 0.5], [1e-9, 1e9]])
    def test_curves_of_any_values_can_be_drawn(self, values):
        assert np.isfinite(curves.paint({"training": values, "validation": values})).all()

    def test_curves_of_another_training_with_as_many_epochs_are_painted(self, monkeypatch):
        """The curves of the last training may be freed, and the next may get their id."""
        image, painted = curves.CurvesImage(), []
        pixels = SimpleNamespace(foreach_set=lambda values: painted.append(values.tolist()))
        preview = SimpleNamespace(icon_id=1, image_pixels_float=pixels)
        monkeypatch.setattr(image, "_previews", {"curves": preview})
        monkeypatch.setattr(curves, "paint", lambda shown: list(shown["training"]))
        live = {"training": [0.9, 0.5], "validation": [1.0, 0.6]}
        for _ in range(2):
            image.icon(live)
        live["training"].append(0.4)
        image.icon(live)
        del live
        for number in range(20):
            image.icon({"training": [0.9, 0.5, float(number)], "validation": [1.0, 0.6]})
        assert painted == [[0.9, 0.5], [0.9, 0.5, 0.4], *([0.9, 0.5, float(number)] for number in range(20))]

    def test_a_report_is_read_and_a_damaged_one_passed_over(self, elbow_files, tmp_path):
        report = _read_report(elbow_files.model)
        assert report["model"] == "elbow.onnx" and {p["joint"] for p in report["partitions"]} == {"upper", "lower"}
        assert _read_report(elbow_files.model.with_name("other.onnx")) is None, "the report is of another model"
        warned = (json.dumps({**report, "warnings": value}) for value in ([{"text": "…"}], 7))
        for number, text in enumerate(("{", "[]", '{"model": 1, "fdda": {}, "partitions": []}', *warned)):
            (tmp_path / str(number)).mkdir()
            (tmp_path / str(number) / "report.json").write_text(text)
            assert _read_report(tmp_path / str(number) / "elbow.onnx") is None

    def test_its_trainer_ends_with_the_file(self, rig, elbow_files, tmp_path):
        from fdda_addon.training.process import Training

        trainings = []

        def steps():
            with Training([str(elbow_files.recording), str(tmp_path / "m.onnx"), "--passes", "100000"]) as training:
                trainings.append(training)
                yield from training.messages(wait=False)

        run = JobRunner(JobState("train", "Training"), steps(), str, str)
        run.advance(0)
        process = trainings[0]._process
        assert process.poll() is None
        bpy.ops.wm.read_factory_settings(use_empty=True)
        assert process.poll() is not None and job.current() is None
        assert not (tmp_path / "m.onnx").exists()


def times_of(
    model_ms: float, linear_ms: float = 1.0, bones_ms: float = 1.0, factors: tuple = (1.0, 1.0, 1.0)
) -> Benchmark:
    """Return times of a rig that takes 10 ms, and in each round these times with its models, times a factor."""
    medians = {"rig": 10.0, "linear": linear_ms, "fdda": model_ms, "without_meshes": bones_ms, "bones": bones_ms}
    rounds = {name: [ms * (factor if name == "fdda" else 1) for factor in factors] for name, ms in medians.items()}
    return Benchmark("rig", (MeshTimes("body", 100, has_model=True),), 1, 3, rounds, rounds, 0, True)


@pytest.mark.parametrize(
    ("times", "sentence"),
    [
        (times_of(2.0), "Worth it: 5.0x faster than the rig (estimate)."),
        (
            times_of(8.0, linear_ms=7.0, bones_ms=6.5),
            "Little difference: 1.2x faster than the rig (estimate). The bones take 6.50 of 10.00 ms, which models do "
            "not change.",
        ),
        (
            times_of(12.0, linear_ms=9.0),
            "Not worth it here: the rig is faster than its model (estimate). The rig takes only 1.00 ms more than "
            "linear skinning alone.",
        ),
        (
            times_of(12.0),
            "Not worth it here: the rig is faster than its model (estimate). The mesh takes only 9.00 ms with the rig, "
            "and 11.00 ms with its model.",
        ),
        # The quartiles count: on a busy machine nothing is worth it.
        (
            times_of(5.0, factors=(0.6, 0.9, 3.3)),
            "The machine is busy: 1.4 to 2.8x as fast as the rig in repeated measurements (estimate). Measure again "
            "when it is idle.",
        ),
    ],
)
def test_the_verdict_about_speed_has_a_reason(times, sentence):
    assert times.sentence == sentence
    assert times.is_worthwhile == sentence.startswith("Worth it")


@pytest.mark.parametrize(
    "seconds, text", [(0.2, "1 s"), (89, "89 s"), (90, "2 min"), (3600, "60 min"), (7800, "2 h 10 min")]
)
def test_durations(seconds, text):
    assert format_duration(seconds) == text


def test_the_worst_frames_are_those_of_the_last_of_several_evaluations():
    from fdda_addon.evaluation.last_evaluation import LastEvaluation

    def evaluation(worst: int) -> LastEvaluation:
        errors = np.full((3, 4), 1e-4, np.float32)
        errors[worst] = 1e-3
        return LastEvaluation("", "m", 0, 0, {"fdda": errors, "linear": errors}, {}, (), ())

    evaluations = [evaluation(worst) for worst in (1, 2, 0)]
    assert [last.worst_poses(2)[0][0] for last in evaluations] == [1, 2, 0]
    assert [len(evaluations[0].worst_poses(count)) for count in (3, 1)] == [3, 1]


@pytest.mark.parametrize("changes_scene", [True, False])
def test_timed_values_are_computed_beside_a_job_unless_the_job_changes_the_scene(fresh, changes_scene):
    values, computed = TimedValues(), []
    assert values.get(computed.append, fresh.mesh_object, 0) is None
    job_runner = JobRunner(JobState("count", "Counting", changes_scene=changes_scene), iter(()), str, str)
    try:
        assert values.tick() is None
        assert computed == ([] if changes_scene else [fresh.mesh_object])
    finally:
        job_runner.end("", "INFO")
        values.stop()


def test_timed_values_are_computed_when_they_are_due(fresh):
    values, names = TimedValues(), ["first", "second"]

    def read(_mesh_object: bpy.types.Object) -> str:
        return names[0]

    assert values.get(read, fresh.mesh_object, 60) is None
    assert values.tick() is None and values.get(read, fresh.mesh_object, 60) == "first"
    del names[0]
    assert 50 < values.tick() <= 60 and values.get(read, fresh.mesh_object, 60) == "first"
    assert values.compute_now(read, fresh.mesh_object) == "second"
    assert values.get(read, fresh.mesh_object, 60) == "second"
    bpy.data.objects.remove(fresh.mesh_object)
    assert values.tick() is not None, "the request is not due"
    values.stop()
    assert values.tick() is None


def test_a_value_is_computed_again_when_an_input_changes_or_another_file_is_opened():
    counts: list[int] = []

    def computed(*inputs: object) -> int:
        return draw_cache.computed_once(("count", "name"), inputs, lambda: counts.append(0) or len(counts))

    first, second = RigCheck((), None, ()), RigCheck((), None, ())
    assert [computed(first, 1), computed(first, 1), computed(second, 1), computed(second, 2)] == [1, 1, 2, 3]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert computed(second, 2) == 4
