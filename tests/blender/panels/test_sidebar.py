# SPDX-License-Identifier: GPL-3.0-or-later
"""The sections of the sidebar, drawn and computed without a window."""

import json
import webbrowser
from pathlib import Path
from types import MethodType, SimpleNamespace
from urllib.parse import urlsplit
from urllib.request import url2pathname

import bpy
import numpy as np
import pytest

from fdda_addon.core.recording.folder import FolderState
from fdda_addon.evaluation import last_evaluation
from fdda_addon.jobs import job
from fdda_addon.jobs.job import JobRunner
from fdda_addon.jobs.state import JobState, format_duration
from fdda_addon.operators.meshes import MENU_OPERATORS
from fdda_addon.panels import MODULES, checks, curves, findings, limits, models, playback
from fdda_addon.panels.recording import cached_content
from fdda_addon.panels.section import panel_rig, short_bone_name
from fdda_addon.panels.timed_value import TimedValues, timed_values
from fdda_addon.panels.training import _read_report
from fdda_addon.poses.motion_range import clear_rotation_range, set_rotation_range
from fdda_addon.properties.character import model_file, recording_folder
from fdda_addon.properties.recording_options import copy_settings, meshes_with_other_settings
from fdda_addon.recording.rig_check import RigCheck
from fdda_addon.rig.dependencies import read_dependencies
from fdda_addon.scene import draw_cache
from fdda_addon.scene.compatibility import is_selected
from fdda_addon.scene.scene_rig import SceneRig
from fdda_addon.timing.benchmark import Benchmark, MeshTimes

from ..conftest import ELBOW, ELBOW_RIG
from ..drawing import Context, DrawnElement, Layout, texts_of
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
    return Benchmark("rig", (MeshTimes("body", 100, has_model=True),), 1, 3, rounds, rounds, True)


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


MAX_OPEN_FIELDS = 5
"""Number of fields that a section shows at most before the user opens a sub-panel."""


def draw_section(name: str) -> list[DrawnElement]:
    """Return what a section draws, and check that its header has the button of the manual."""
    section, drawn, drawn_header = getattr(bpy.types, f"FDDA_PT_{name}"), [], []
    header = SimpleNamespace(layout=Layout(drawn_header), bl_label=section.bl_label, is_done=section.is_done)
    header.has_warning = section.has_warning
    section.draw_header_preset(header, Context())
    assert "Manual" in texts_of(drawn_header)
    panel = SimpleNamespace(layout=Layout(drawn), verbs=section.verbs, is_done=section.is_done)
    for method_name in ("enabled_layout", *(name for name in vars(section) if name.startswith("_draw"))):
        setattr(panel, method_name, MethodType(getattr(section, method_name), panel))
    section.draw(panel, Context())
    return drawn


@pytest.mark.parametrize("name", MODULES)
def test_a_section_of_a_rig_draws_few_fields(rig: SceneRig, name: str):
    bpy.context.view_layer.objects.active = rig.mesh_object
    checks.check_now(rig)
    drawn = draw_section(name)
    assert drawn
    fields = [text for kind, text, is_open in drawn if kind == "field" and is_open]
    assert len(fields) <= MAX_OPEN_FIELDS, fields


def test_missing_limits_are_named_beside_the_button_that_records(rig: SceneRig, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "rig.blend"))
    bpy.context.view_layer.objects.active = rig.mesh_object
    text, bones = "No rotation limits yet: set them in Training Poses first.", rig.armature_object.pose.bones
    for bone in bones:
        bone.lock_rotation = (False, False, False)
        for axis in range(3):
            clear_rotation_range(bone, axis)
    checks.check_now(rig)
    # Limbs come from the action of the elbow.
    assert text not in texts_of(draw_section("rig"))
    bpy.data.actions.remove(bpy.data.actions["elbow_wave"])
    checks.check_now(rig)
    assert text in texts_of(draw_section("rig"))
    set_rotation_range(bones[1], 0, 0.0, 2.0)
    checks.check_now(rig)
    assert text not in texts_of(draw_section("rig"))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("rig", "Replaced by the Model:"),
        ("poses", "Also Record Actions"),
        ("recording", "Record"),
        ("training", "Train"),
        ("playback", "Confidence in This Pose"),
        ("evaluation", "Max Color (mm)"),
        ("models", "Matches this rig"),
    ],
)
def test_a_section_of_a_bound_model_draws(active: bpy.types.Object, name: str, text: str):
    checks.check_now(SceneRig(active, bpy.data.objects[ELBOW_RIG]))
    bpy.ops.fdda.evaluate()
    bpy.ops.fdda.measure(frames=5)
    bpy.ops.fdda.color_mesh(colors="ERRORS")
    timed_values.compute_now(playback._read_confidence, active)
    timed_values.compute_now(models._find_problems, active)
    assert text in texts_of(draw_section(name))


def test_the_reason_stays_in_view_without_an_armature(active: bpy.types.Object):
    bpy.data.objects.remove(bpy.data.objects[ELBOW_RIG])
    bpy.context.view_layer.update()
    assert active.fdda.status and " ".join(active.fdda.status.split()) in " ".join(texts_of(draw_section("rig")))


def test_a_fast_rig_offers_no_comparison_with_the_rig(active: bpy.types.Object):
    sections = ("rig", "playback", "evaluation")
    compared = {"Record, Train & Bind", "Measure Speed", "Frame Profile", "Rig", "Evaluate", "Beside"}
    full_texts = {text for name in sections for text in texts_of(draw_section(name))}
    assert compared <= full_texts
    active.fdda.is_fast_rig = True
    fast_texts = {text for name in sections for text in texts_of(draw_section(name))}
    assert not compared & fast_texts and {"Skinning", "Model", "Unbind"} <= fast_texts
    assert "This is a fast rig: compare the model in the file of the full rig." in fast_texts


def test_a_fast_rig_in_which_no_model_plays_says_so(active: bpy.types.Object):
    note = "'elbow' belongs to a fast rig: without a model, only what is left of its bones and modifiers deforms it."

    def says_so() -> bool:
        return any(text.startswith(note) for text in texts_of(draw_section("playback")))

    active.fdda.is_fast_rig = active.fdda.use_in_render = True
    assert not says_so()
    # The user hides the modifier, which shows the rig in a full rig.
    active.modifiers["FDDA"].show_viewport = False
    bpy.context.view_layer.update()
    assert active.fdda.mode == "RIG" and says_so()
    bpy.ops.fdda.unbind()
    assert says_so()
    active.fdda.is_fast_rig = False
    assert not says_so()


def test_a_fast_rig_says_where_no_model_plays(active: bpy.types.Object):
    """In some frames, or in renders, while the viewport shows the model."""

    def notes() -> list[str]:
        return [text for text in texts_of(draw_section("playback")) if "belongs to a fast rig" in text]

    active.fdda.is_fast_rig, active.fdda.use_in_render = True, False
    left = "only what is left of its bones and modifiers deforms it."
    assert notes() == [
        f"'elbow' belongs to a fast rig: in renders, where the model is off, {left} Switch Use in Render on, or open "
        "the file of the full rig."
    ]
    active.fdda.use_in_render = True
    assert notes() == []
    keyed = f"'elbow' belongs to a fast rig: where its keyed or driven mode is Rig, {left} Remove these keys or the "
    active.keyframe_insert("fdda.mode", frame=1)
    assert len(notes()) == 1 and notes()[0].startswith(keyed)
    active.animation_data_clear()
    assert notes() == []
    active.driver_add("fdda.mode")
    assert len(notes()) == 1 and notes()[0].startswith(keyed)
    active.fdda.is_fast_rig = False
    assert notes() == []


def test_a_removed_modifier_can_be_bound_again(active: bpy.types.Object):
    bpy.context.view_layer.update()
    active.modifiers.remove(active.modifiers["FDDA"])
    bpy.context.view_layer.update()
    assert "was removed; bind the model again" in active.fdda.status
    texts = texts_of(draw_section("playback"))
    assert "Bind Again" in texts and "Try Again" not in texts
    assert bpy.ops.fdda.bind(object=active.name) == {"FINISHED"}
    assert active.fdda.mode == "FDDA" and not active.fdda.status
    active.modifiers["FDDA"].show_viewport = False
    bpy.context.view_layer.update()
    assert "Try Again" in texts_of(draw_section("playback"))


def test_worst_random_poses_are_numbered_from_1_as_in_the_preview(active: bpy.types.Object, capfd):
    bpy.ops.fdda.evaluate(source="RANDOM", poses=3)
    index, error_mm = last_evaluation.get(active).worst_poses(1)[0]
    assert f"Pose {index + 1}: {error_mm:.2f} mm" in texts_of(draw_section("evaluation"))
    bpy.ops.fdda.jump_to_worst()
    assert f"Random pose {index + 1}: max error {error_mm:.2f} mm." in capfd.readouterr().out


def test_the_menu_has_all_operators_but_those_that_need_a_button_of_a_panel():
    in_menu = {name.removeprefix("fdda.") for group in MENU_OPERATORS for name in group}
    assert set(dir(bpy.ops.fdda)) - in_menu == {
        *("add_trusted_folder", "remove_trusted_folder"),
        *("cancel", "cancel_trainer_environment", "remove_trainer_environment"),
        *("show_bone", "show_mesh", "copy_objects"),
    }


@pytest.mark.parametrize("name", MODULES)
def test_a_section_without_a_rig_draws(name: str):
    texts = texts_of(draw_section(name))
    if name == "rig":
        assert "Add Sample Arm" in texts


def test_lists_draw_their_items(active: bpy.types.Object):
    control = active.fdda.settings.extra_inputs.add()
    control.name, control.has_range = "flex", True
    assert list_items("poses") == [
        "Record elbow_wave 1…30",
        "Select upper ±45°  ±45°  ±45°",
        "Select lower 0…120°  locked  locked",
        "flex 0…1",
    ]
    assert list_items("models") == ["Name"]
    rig = SceneRig(active, active.find_armature())
    lower = rig.armature_object.pose.bones["lower"]
    assert limits._bone_row(rig, lower, False)[2] == "120°  lock  lock", "a narrow sidebar cuts a longer text"


def list_items(section_name: str) -> list[str]:
    """Return the text of each list item that a section draws. Of a field, the text is the name of its property."""
    return [text for kind, text, _ in draw_section(section_name) if kind == "list item"]


def test_the_button_in_the_header_of_a_section_opens_the_manual(monkeypatch: pytest.MonkeyPatch):
    addresses = []
    monkeypatch.setattr(webbrowser, "open", addresses.append)
    assert bpy.ops.fdda.help(section="Training Poses") == {"FINISHED"}
    (address,) = addresses
    page, _, anchor = address.partition("#")
    assert anchor == "training-poses"
    assert "\n### Training Poses\n" in Path(url2pathname(urlsplit(page).path)).read_text(encoding="utf-8")


def split_vertices(mesh_object: bpy.types.Object) -> None:
    """Give each face its own vertices, as importers of game formats do."""
    import bmesh  # bpy brings it, so it is there after bpy has loaded.

    edited = bmesh.new()
    edited.from_mesh(mesh_object.data)
    bmesh.ops.split_edges(edited, edges=edited.edges)
    edited.to_mesh(mesh_object.data)
    edited.free()


def remove_weights(mesh_object: bpy.types.Object) -> None:
    mesh_object.vertex_groups.clear()


def leave_only_skinning(mesh_object: bpy.types.Object) -> None:
    mesh_object.modifiers.remove(mesh_object.modifiers["CorrectiveSmooth"])


def remove_limits(mesh_object: bpy.types.Object) -> None:
    bone = bpy.data.objects[ELBOW_RIG].pose.bones["lower"]
    for constraint in list(bone.constraints):
        bone.constraints.remove(constraint)
    other = bpy.data.objects[ELBOW_RIG].pose.bones["upper"].constraints.new("LIMIT_ROTATION")
    other.use_limit_x, other.owner_space = True, "LOCAL"


@pytest.mark.parametrize(
    ("change", "text", "button"),
    [
        (split_vertices, "vertices lie on others along cuts, which come apart.", "merge_vertices"),
        (remove_weights, "No vertex of elbow has weights on deforming bones.", "fit_base_skinning"),
        (leave_only_skinning, "Only linear skinning deforms elbow: a model is not worth it.", ""),
        (remove_limits, "1 of 2 bones have no rotation limits, and turn by ±45°.", "select_unlimited"),
    ],
)
def test_what_makes_a_good_model_unlikely_has_a_remedy(saved: SceneRig, change, text: str, button: str):
    bpy.context.view_layer.objects.active = saved.mesh_object
    checks.check_now(saved)
    assert not findings.find(saved) and bpy.types.FDDA_PT_rig.is_done(bpy.context)
    vertex_count = len(saved.mesh_object.data.vertices)
    change(saved.mesh_object)
    bpy.context.view_layer.update()
    checks.unregister()
    checks.check_now(saved)
    (finding,) = findings.find(saved)
    assert finding.text.endswith(text) and finding.operator == (f"fdda.{button}" if button else "")
    assert not bpy.types.FDDA_PT_rig.is_done(bpy.context)
    assert f"{ELBOW_RIG}: 2 bones" in texts_of(draw_section("rig")), "the joint of a mesh without weights is no bone"
    assert " ".join(finding.text.split()) in " ".join(" ".join(texts_of(draw_section("rig"))).split())
    if button:
        assert getattr(bpy.ops.fdda, button)() == {"FINISHED"}
    if button == "select_unlimited":
        bones = saved.armature_object.pose.bones
        assert bpy.context.mode == "POSE" and [bone.name for bone in bones if is_selected(bone)] == ["lower"]
    elif button:
        checks.unregister()
        checks.check_now(saved)
        assert not findings.find(saved) and len(saved.mesh_object.data.vertices) == vertex_count
    else:
        saved.mesh_object.modifiers["Armature"].use_deform_preserve_volume = True
        checks.check_now(saved)
        assert not findings.find(saved)


def test_deforming_bones_that_follow_control_bones_are_named(saved: SceneRig):
    """Random poses would move the few others, and a tick would say that all is well."""
    armature_object = saved.armature_object
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    control = armature_object.data.edit_bones.new("control")
    control.tail, control.use_deform = (0, 0, 1), False
    bpy.ops.object.mode_set(mode="OBJECT")
    pose_bones = armature_object.pose.bones
    for name in ("upper", "lower"):
        constraint = pose_bones[name].constraints.new("COPY_ROTATION")
        constraint.target, constraint.subtarget = armature_object, "control"
    limit = pose_bones["control"].constraints.new("LIMIT_ROTATION")
    limit.use_limit_x, limit.max_x, limit.owner_space = True, 1.0, "LOCAL"
    checks.check_now(saved)
    (finding,) = findings.find(saved)
    assert finding.text == (
        "2 of 2 deforming bones follow control bones. Check actions that move these, or choose them as Bones to Pose."
    )
    assert not bpy.types.FDDA_PT_rig.is_done(bpy.context) and not bpy.types.FDDA_PT_poses.is_done(bpy.context)
    key_bone(pose_bones["control"])
    bpy.data.actions["wave"].fdda.record = True
    checks.check_now(saved)
    assert not findings.find(saved) and bpy.types.FDDA_PT_poses.is_done(bpy.context)


def test_shared_settings_are_named_and_other_ones_before_they_are_replaced(saved: SceneRig):
    sleeve = saved.mesh_object.copy()
    sleeve.name = "sleeve"
    bpy.context.collection.objects.link(sleeve)
    bpy.context.view_layer.objects.active = saved.armature_object
    shared = "Shared by 2 Meshes"
    assert shared in texts_of(draw_section("poses"))
    assert meshes_with_other_settings(saved.mesh_object, [saved.mesh_object, sleeve]) == []
    for name, value in (("seed", 3), ("poses", 50), ("bones_to_pose", "WEIGHTS"), ("recording", "//other")):
        setattr(sleeve.fdda.settings, name, value)
        assert meshes_with_other_settings(saved.mesh_object, [saved.mesh_object, sleeve]) == ["sleeve"]
        copy_settings(sleeve, saved.mesh_object)
        assert meshes_with_other_settings(saved.mesh_object, [saved.mesh_object, sleeve]) == []
    assert sleeve.fdda.settings.auto_poses
    sleeve.fdda.settings.extra_inputs.add().name = "bulge"
    text = " ".join(" ".join(texts_of(draw_section("poses"))).split())
    assert "Record replaces other settings of 'sleeve'." in text or "of 'elbow'." in text


def key_bone(bone: bpy.types.PoseBone) -> None:
    """Make an action "wave" in which a bone rotates."""
    bone.id_data.animation_data.action = bpy.data.actions.new("wave")
    bone.rotation_mode = "XYZ"
    for frame in (1, 10):
        bone.rotation_euler[0] = frame / 20
        bone.keyframe_insert("rotation_euler", frame=frame)


def test_merging_keeps_normals_and_the_cuts_that_weights_or_shape_keys_open(saved: SceneRig):
    mesh_object, mesh = saved.mesh_object, saved.mesh_object.data
    vertex_count = len(mesh.vertices)
    split_vertices(mesh_object)
    normals = np.random.default_rng(0).normal(size=(len(mesh.loops), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mesh.normals_split_custom_set(normals)

    def corner_normals() -> dict[tuple, np.ndarray]:
        return {
            (tuple(face.center), tuple(mesh.vertices[mesh.loops[i].vertex_index].co)): mesh.corner_normals[i].vector[:]
            for face in mesh.polygons
            for i in face.loop_indices
        }

    before = corner_normals()
    mesh_object.vertex_groups["lower"].add([0], 0.3, "REPLACE")
    mesh_object.vertex_groups["upper"].add([0], 0.7, "REPLACE")
    mesh_object.shape_key_add(name="Basis")
    mesh_object.shape_key_add(name="open").data[len(mesh.vertices) - 1].co.z += 0.1
    bpy.context.view_layer.objects.active = mesh_object
    # The second time nothing is left to merge.
    for _ in range(2):
        assert bpy.ops.fdda.merge_vertices() == {"FINISHED"}
        assert len(mesh.vertices) == vertex_count + 2
    after = corner_normals()
    assert after.keys() == before.keys() and "fdda_normals" not in mesh.attributes
    np.testing.assert_allclose([after[key] for key in before], list(before.values()), atol=1e-3)
    basis, opened = mesh.shape_keys.key_blocks
    heights = [opened.data[i].co.z - basis.data[i].co.z for i in range(len(mesh.vertices))]
    assert sorted(heights)[-2:] == pytest.approx([0.0, 0.1])


def test_usual_prefixes_of_bone_names_are_omitted():
    names = ("mixamorig:LeftArm", "char01:body:arm", "DEF-spine.L", "CC_Base_L_Thigh", "Bip001 R Calf", "upper", "a:")
    assert [*map(short_bone_name, names)] == ["LeftArm", "arm", "spine.L", "L_Thigh", "R Calf", "upper", "a:"]
