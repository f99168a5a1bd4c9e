# SPDX-License-Identifier: GPL-3.0-or-later
"""From the sample arm to a model with operators alone, without a window: values, sentences, canceling and undo."""

import json
import math
import os
import socket
from pathlib import Path

import bpy
import numpy as np
import pytest

from fdda_addon.core.model import read_model_info
from fdda_addon.core.poses import sample_pose
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.lock import LOCK_NAME
from fdda_addon.core.recording.lock import _lock as lock_file
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.jobs import job
from fdda_addon.operators.rig import measured_cost
from fdda_addon.poses.sampling import sampled_channels
from fdda_addon.properties.character import model_file
from fdda_addon.recording.plan import RecordingSettings, make_recording_margin
from fdda_addon.rig.reading import read_rig
from fdda_addon.scene import undo
from fdda_addon.scene.scene_rig import SceneRig

from .conftest import ELBOW, ELBOW_RIG
from .scene_state import assert_same_state, scene_state


@pytest.fixture
def saved(rig: SceneRig, tmp_path: Path) -> SceneRig:
    """The elbow, active, in a file of its own."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "elbow.blend"))
    bpy.context.view_layer.objects.active = rig.mesh_object
    return rig


def recorded_folder(tmp_path: Path) -> Path:
    return tmp_path / "elbow_recording"


class TestRig:
    def test_the_cube_of_a_new_file_is_out_of_the_way_and_the_arm_in_view(self):
        bpy.ops.wm.read_factory_settings()
        assert bpy.ops.fdda.add_sample_arm(density="1") == {"FINISHED"}
        assert not bpy.data.objects["Cube"].visible_get() and bpy.data.objects["Cube"].hide_render
        views = [a.spaces.active.region_3d for s in bpy.data.screens for a in s.areas if a.type == "VIEW_3D"]
        assert views
        for view in views:
            assert 0.2 < view.view_location.x < 0.6 and 0.5 < view.view_distance < 1.5

    def test_the_arm_is_added_to_the_scene_that_is_there(self):
        bpy.ops.mesh.primitive_cube_add()
        cube = bpy.context.active_object
        cube.location.x = 3
        bpy.context.view_layer.update()
        assert bpy.ops.fdda.add_sample_arm() == {"FINISHED"}
        arm = bpy.context.active_object
        assert arm.name == "arm" and len(arm.data.vertices) == 9960 and arm.select_get()
        assert cube.visible_get(), "somebody has moved it"
        assert cube.name in bpy.context.scene.objects and not cube.select_get()
        assert bpy.context.scene.frame_end == 250

    def test_a_second_arm_has_a_rig_of_its_own(self):
        bpy.ops.fdda.add_sample_arm(density="1")
        bpy.context.scene.frame_end = 77
        bpy.ops.fdda.add_sample_arm(density="1")
        second = bpy.context.active_object
        assert second.name == "arm.001" and second.modifiers["Armature"].object.name == "arm_rig.001"
        driver = second.data.shape_keys.animation_data.drivers[0].driver
        assert driver.variables[0].targets[0].id.name == "arm_rig.001"
        assert bpy.context.scene.frame_end == 77, "the range belongs to whoever animates already"

    def test_adding_the_arm_can_be_undone(self):
        bpy.ops.ed.undo_push()
        bpy.ops.fdda.add_sample_arm(density="1")
        bpy.ops.ed.undo_push()
        bpy.ops.ed.undo()
        assert "arm" not in bpy.data.objects and "arm_rig" not in bpy.data.objects

    def test_not_in_edit_mode(self, saved):
        bpy.ops.object.mode_set(mode="EDIT")
        with pytest.raises(RuntimeError, match="Objects can only be added in Object Mode"):
            bpy.ops.fdda.add_sample_arm(density="1")

    def test_measuring_gives_back_the_scene_and_keeps_the_cost(self, saved):
        before = scene_state(saved)
        assert bpy.ops.fdda.measure() == {"FINISHED"}
        assert_same_state(before, scene_state(saved))
        cost = measured_cost(saved.mesh_object)
        assert cost.vertices == len(saved.mesh_object.data.vertices)
        assert cost.rig > cost.linear > 0 and cost.model > cost.linear
        assert job.state_of("measure").outcome.endswith("Not worth it here: this rig is faster than a model.")

    def test_what_cannot_be_evaluated_is_not_measured(self, saved):
        saved.armature_object.data.pose_position = "REST"
        with pytest.raises(RuntimeError, match="The armature 'elbow_rig' shows its rest position; set it to pose"):
            bpy.ops.fdda.measure()


class TestWhichRig:
    def test_nothing_active(self):
        with pytest.raises(RuntimeError, match="Nothing with a rig is active; select the mesh of a character"):
            bpy.ops.fdda.record()

    def test_a_mesh_without_a_rig_but_another_with_one(self, saved):
        bpy.ops.mesh.primitive_cube_add()
        with pytest.raises(RuntimeError, match="'Cube' has no Armature modifier with an armature"):
            bpy.ops.fdda.measure()
        assert bpy.ops.fdda.measure(object=ELBOW) == {"FINISHED"}

    def test_a_name_that_is_not_there(self, saved):
        with pytest.raises(RuntimeError, match="The scene has no mesh object 'none'; its mesh objects: 'elbow'"):
            bpy.ops.fdda.record(object="none")

    def test_the_armature_stands_for_its_mesh(self, saved):
        bpy.context.view_layer.objects.active = saved.armature_object
        assert bpy.ops.fdda.measure() == {"FINISHED"}

    def test_of_two_meshes_the_selected_or_the_chosen_one_is_meant(self, saved):
        other = saved.mesh_object.copy()
        other.data = saved.mesh_object.data.copy()
        bpy.context.scene.collection.objects.link(other)
        for mesh_object in (saved.mesh_object, other):
            mesh_object.select_set(False)
        bpy.context.view_layer.objects.active = saved.armature_object
        assert bpy.ops.fdda.measure() == {"FINISHED"}
        assert job.state_of("measure").subject == saved.mesh_object.session_uid
        bpy.context.window_manager.fdda.mesh = other.name
        assert bpy.ops.fdda.measure() == {"FINISHED"}
        assert job.state_of("measure").subject == other.session_uid
        saved.mesh_object.select_set(True)
        assert bpy.ops.fdda.measure() == {"FINISHED"}
        assert job.state_of("measure").subject == saved.mesh_object.session_uid


class TestPoses:
    def test_the_poses_that_are_shown_are_those_that_are_recorded(self, saved):
        settings = saved.mesh_object.fdda.settings
        settings.seed, settings.spread = 7, 0.5
        channels = sampled_channels(saved, read_rig(saved))
        assert bpy.ops.fdda.preview_pose(number=3) == {"FINISHED"}
        assert bpy.ops.fdda.preview_pose(step=1) == {"FINISHED"}
        assert bpy.context.window_manager.fdda.pose_index == 4
        bones = saved.armature_object.pose.bones
        shown = [bones[c.name].rotation_euler[c.axis] for c in channels]
        np.testing.assert_allclose(shown, sample_pose(channels, 7, 4, 0.5), atol=1e-6)
        bpy.ops.fdda.preview_pose(number=0, step=-1)
        assert bpy.context.window_manager.fdda.pose_index == 0

    def test_the_number_field_shows_a_pose(self, saved):
        session, bones = bpy.context.window_manager.fdda, saved.armature_object.pose.bones
        bpy.ops.fdda.preview_pose(number=2)
        shown = [tuple(bone.rotation_euler) for bone in bones]
        assert session.preview_pose == 3
        session.preview_pose = 1
        assert session.pose_index == 0 and [tuple(bone.rotation_euler) for bone in bones] != shown
        session.preview_pose = 3
        assert [tuple(bone.rotation_euler) for bone in bones] == shown
        for bone in bones:
            bone.lock_rotation = (True, True, True)
        session.preview_pose = 5
        assert session.preview_pose == 3, "there is nothing to pose"

    def test_back_to_rest_and_undone(self, saved):
        bpy.ops.fdda.preview_pose(number=1)
        bpy.ops.ed.undo_push()
        angle = saved.armature_object.pose.bones["lower"].rotation_euler[0]
        assert angle != 0
        assert bpy.ops.fdda.rest_pose() == {"FINISHED"}
        assert saved.armature_object.pose.bones["lower"].rotation_euler[0] == 0
        bpy.ops.ed.undo_push()
        bpy.ops.ed.undo()
        assert bpy.data.objects[ELBOW_RIG].pose.bones["lower"].rotation_euler[0] == pytest.approx(angle)

    def test_poses_of_the_margin_are_shown_as_they_are_recorded(self, saved):
        settings = saved.mesh_object.fdda.settings
        settings.poses, settings.margin = 8, 2.0
        recording_settings = RecordingSettings(poses=8, margin=2.0)
        channels = sampled_channels(saved, read_rig(saved))
        margin = make_recording_margin(saved, recording_settings, channels)
        bones = saved.armature_object.pose.bones
        for number, expected_channels in ((5, channels), (6, margin.channels), (7, margin.channels)):
            bpy.ops.fdda.preview_pose(number=number)
            shown = [bones[c.name].rotation_euler[c.axis] for c in expected_channels]
            np.testing.assert_allclose(shown, sample_pose(expected_channels, 0, number), atol=1e-6)

    def test_a_preview_ends_at_the_last_random_pose(self, saved):
        session = bpy.context.window_manager.fdda
        saved.mesh_object.fdda.settings.poses = 8
        bpy.ops.fdda.preview_pose(number=8)
        assert session.pose_index == 7
        bpy.ops.fdda.preview_pose(step=1)
        assert session.pose_index == 7
        session.preview_pose = 100
        assert session.preview_pose == 8

    @pytest.mark.parametrize("operator", ["undo", "redo"])
    def test_an_undo_cancels_the_step_that_is_to_be_added(self, saved, operator):
        bpy.ops.fdda.preview_pose(number=1)
        for name in ("first", "second"):
            bpy.ops.ed.undo_push(message=name)
        if operator == "redo":
            bpy.ops.ed.undo()
        bpy.app.timers.register(undo._push_undo, first_interval=60)
        getattr(bpy.ops.ed, operator)()
        assert not bpy.app.timers.is_registered(undo._push_undo)

    def test_nothing_to_pose(self, saved):
        for bone in saved.armature_object.pose.bones:
            bone.lock_rotation = (True, True, True)
        with pytest.raises(RuntimeError, match="No bone of 'elbow_rig' may be sampled"):
            bpy.ops.fdda.preview_pose()

    def ranges(self, rig: SceneRig) -> dict[str, tuple[float, float]]:
        return {
            f"{c.name} {'XYZ'[c.axis]}": (round(math.degrees(c.low)), round(math.degrees(c.high)))
            for c in sampled_channels(rig, read_rig(rig))
        }

    def test_a_range_is_written_where_the_bone_has_it(self, saved):
        bone = saved.armature_object.pose.bones["upper"]
        result = bpy.ops.fdda.set_limit(bone="upper", axis="Y", low=math.radians(10), high=math.radians(60))
        assert result == {"FINISHED"} and self.ranges(saved)["upper Y"] == (10, 60)
        assert math.degrees(bone.constraints[0].min_y) == pytest.approx(10)
        assert not bone.use_ik_limit_y

    def test_a_bone_without_limits_gets_those_that_leave_posing_free(self, saved):
        bone = saved.armature_object.pose.bones["upper"]
        bone.constraints.remove(bone.constraints[0])
        bone.lock_rotation[2] = True
        bpy.ops.fdda.set_limit(bone="upper", axis="Z", low=-1, high=0.5)
        assert self.ranges(saved)["upper Z"] == (-57, 29) and self.ranges(saved)["upper X"] == (-45, 45)
        assert bone.use_ik_limit_z and not bone.constraints
        with pytest.raises(RuntimeError, match="IK limits, which must include the rest pose; begin at 0 or below"):
            bpy.ops.fdda.set_limit(bone="upper", axis="X", low=0.5, high=1)
        bpy.ops.fdda.clear_limit(bone="upper", axis="Z")
        assert self.ranges(saved)["upper Z"] == (-45, 45)
        bpy.ops.fdda.set_limit(bone="upper", axis="X", low=0.5, high=1)
        assert self.ranges(saved)["upper X"] == (29, 57) and len(bone.constraints) == 1

    def test_an_empty_range_and_an_unknown_bone(self, saved):
        with pytest.raises(RuntimeError, match="The range of 'upper' about Y is empty; give a larger maximum"):
            bpy.ops.fdda.set_limit(bone="upper", axis="Y", low=1, high=0)
        with pytest.raises(RuntimeError, match="'elbow_rig' has no bone 'tail'; give the name of one"):
            bpy.ops.fdda.clear_limit(bone="tail", axis="Y")


class TestRecording:
    def record(self, rig: SceneRig, poses: int = 20, **options) -> set[str]:
        rig.mesh_object.fdda.settings.poses = poses
        return bpy.ops.fdda.record(**options)

    def test_what_the_settings_say_is_recorded_beside_the_file(self, saved, tmp_path):
        settings = saved.mesh_object.fdda.settings
        settings.seed, settings.spread = 5, 0.75
        bpy.data.actions["elbow_wave"].fdda.record = True
        bpy.data.actions.new("of something else").fdda.record = True
        before = scene_state(saved)
        assert self.record(saved) == {"FINISHED"}
        assert_same_state(before, scene_state(saved))
        sampling = read_recording(recorded_folder(tmp_path)).info.sampling
        assert (sampling.seed, sampling.spread) == (5, 0.75)
        assert [(s.kind, s.poses, s.name) for s in sampling.sources] == [
            ("random", 20, ""),
            ("action", 30, "elbow_wave"),
        ]
        assert job.state_of("record").outcome == "Recorded 50 poses into 'elbow_recording'."

    def test_an_unsaved_file_has_no_place_for_it(self):
        bpy.ops.fdda.add_sample_arm(density="1")
        with pytest.raises(
            RuntimeError, match=r"Save the \.blend file first \(recordings are stored next to it\), or choose a Folder"
        ):
            bpy.ops.fdda.record()

    def test_a_folder_that_is_named(self, saved, tmp_path):
        saved.mesh_object.fdda.settings.recording = "//deep/down"
        assert self.record(saved) == {"FINISHED"}
        assert read_index(tmp_path / "deep" / "down")["complete"] == 20
        assert self.record(saved, folder=str(tmp_path / "other")) == {"FINISHED"}
        assert read_index(tmp_path / "other")["complete"] == 20

    def test_cancelled_and_resumed(self, saved, tmp_path, monkeypatch):
        show = job.JobState.show

        def cancel(state, progress):
            show(state, progress)
            if progress.stage == "poses" and progress.done == 8:
                bpy.ops.fdda.cancel()

        before = scene_state(saved)
        with monkeypatch.context() as patch:
            patch.setattr(job.JobState, "show", cancel)
            assert self.record(saved) == {"CANCELLED"}
        assert_same_state(before, scene_state(saved))
        outcome = job.state_of("record").outcome
        complete = read_index(recorded_folder(tmp_path))["complete"]
        assert complete >= 8 and f"{complete} of 20 poses are kept" in outcome
        with pytest.raises(RuntimeError, match="holds a recording already"):
            self.record(saved)
        assert self.record(saved, resume=True) == {"FINISHED"}
        assert len(read_recording(recorded_folder(tmp_path)).residuals) == 20

    def test_another_blender_is_recording_there(self, saved, tmp_path):
        recorded_folder(tmp_path).mkdir()
        lock = recorded_folder(tmp_path) / LOCK_NAME
        lock.write_text(json.dumps({"pid": os.getppid(), "host": socket.gethostname()}))
        with lock.open("r+b") as held:
            # The system's lock is of the open file, so this is another's also in one process.
            assert lock_file(held.fileno())
            with pytest.raises(RuntimeError, match=rf"Another Blender \(process {os.getppid()}\) is recording into"):
                self.record(saved)
        assert lock.exists()

    def test_removing_a_recording(self, saved, tmp_path):
        with pytest.raises(RuntimeError, match="holds no recording; there is nothing to remove"):
            bpy.ops.fdda.delete_recording()
        self.record(saved)
        (recorded_folder(tmp_path) / "notes.txt").write_text("mine")
        assert bpy.ops.fdda.delete_recording() == {"FINISHED"}
        assert [path.name for path in recorded_folder(tmp_path).iterdir()] == ["notes.txt"]

    def test_a_bound_rig_is_recorded_as_the_true_rig(self, bound, elbow, tmp_path):
        bpy.context.view_layer.objects.active = bound
        assert bound.fdda.is_playing
        bound.fdda.settings.poses = 5
        assert bpy.ops.fdda.record(folder=str(tmp_path / "r")) == {"FINISHED"}
        first, again = (read_recording(path).residuals[:5] for path in (elbow.recording, tmp_path / "r"))
        np.testing.assert_allclose(again, first, atol=1e-6)
        assert bound.fdda.is_playing


class TestTraining:
    def train(self, rig: SceneRig, elbow, **options) -> set[str]:
        settings = rig.mesh_object.fdda.settings
        settings.epochs, settings.tolerance_mm, settings.training_seed = 6, 0.2, 3
        return bpy.ops.fdda.train(recording=str(elbow.recording), **options)

    def test_a_model_with_these_settings_and_its_curves(self, saved, elbow, tmp_path):
        saved.mesh_object.fdda.settings.model = "//models/a.onnx"
        assert self.train(saved, elbow) == {"FINISHED"}
        model = tmp_path / "models" / "a.onnx"
        training = read_model_info(model).training
        assert (training["epochs"], training["tolerance_mm"], training["seed"]) == (6, 0.2, 3)
        state = job.state_of("train")
        assert (state.done, state.total) == (6, 6) and state.outcome.startswith("Trained 'a.onnx' in ")
        assert [len(state.curves[name]) for name in ("training", "validation")] == [6, 6]
        assert state.curves["validation"][-1] < state.curves["validation"][0]

    def test_cancelled(self, saved, elbow, tmp_path, monkeypatch):
        show = job.JobState.show

        def cancel(state, progress):
            show(state, progress)
            if progress.done == 2:
                bpy.ops.fdda.cancel()

        monkeypatch.setattr(job.JobState, "show", cancel)
        saved.mesh_object.fdda.settings.epochs = 10_000
        options = {"recording": str(elbow.recording), "model": str(tmp_path / "m.onnx")}
        assert bpy.ops.fdda.train(**options) == {"CANCELLED"}
        assert job.state_of("train").outcome == "Training canceled; no model was written."
        assert not (tmp_path / "m.onnx").exists()

    @pytest.mark.slow
    def test_more_poses_where_the_model_is_worst_and_training_on(self, saved, elbow, tmp_path):
        settings = saved.mesh_object.fdda.settings
        settings.poses, settings.epochs, settings.use_goal, settings.goal_mm = 40, 4, True, 0.001
        assert bpy.ops.fdda.record() == {"FINISHED"}
        with pytest.raises(RuntimeError, match="There is no checkpoint"):
            bpy.ops.fdda.train(warm_start=True)
        assert bpy.ops.fdda.train() == {"FINISHED"}
        before = scene_state(saved)
        assert bpy.ops.fdda.refine(poses=12) == {"FINISHED"}
        assert job.state_of("refine").outcome == "Added 12 poses to 'elbow_recording'; press Continue Training."
        assert_same_state(before, scene_state(saved))
        assert [s.kind for s in read_recording(recorded_folder(tmp_path)).info.sampling.sources] == [
            "random",
            "refined",
        ]
        assert not (recorded_folder(tmp_path) / LOCK_NAME).exists()
        assert bpy.ops.fdda.train(warm_start=True) == {"FINISHED"}
        model = model_file(saved.mesh_object)
        assert read_model_info(model).training["warm_start"]
        report = json.loads((model.parent / "report.json").read_text())
        assert report["poses"] == 52 and report["goal"]["verdict"] == "missed"

    def test_there_must_be_a_model_to_refine(self, saved):
        saved.mesh_object.fdda.settings.poses = 12
        bpy.ops.fdda.record()
        with pytest.raises(RuntimeError, match="train it first"):
            bpy.ops.fdda.refine()

    def test_no_recording_and_one_that_is_not_finished(self, saved, tmp_path):
        with pytest.raises(RuntimeError, match="is not a recording: it has no recording"):
            bpy.ops.fdda.train()
        saved.mesh_object.fdda.settings.poses = 4
        bpy.ops.fdda.record()
        index = recorded_folder(tmp_path) / "recording.json"
        index.write_text(index.read_text().replace('"complete": 4', '"complete": 3'))
        with pytest.raises(RuntimeError, match="The recording 'elbow_recording' has 3 of 4 poses; resume it first"):
            bpy.ops.fdda.train()

    def test_a_python_that_is_not_there(self, saved, elbow, tmp_path, monkeypatch):
        monkeypatch.setenv("FDDA_TRAINER_PYTHON", "/none/python")
        with pytest.raises(RuntimeError, match="The trainer's Python '/none/python' cannot be started"):
            self.train(saved, elbow)
        assert job.current() is None


def test_the_arm_is_in_the_menu_while_the_addon_is_enabled():
    import fdda_addon

    def entries() -> list[str]:
        return [draw.__module__ for draw in bpy.types.VIEW3D_MT_armature_add._dyn_ui_initialize()]

    assert entries().count("fdda_addon.operators.rig") == 1
    fdda_addon.unregister()
    assert "fdda_addon.operators.rig" not in entries()
    fdda_addon.register()
