# SPDX-License-Identifier: GPL-3.0-or-later
"""Recording, evaluating and timing give the scene back as it was, however they end."""

import bpy
import pytest

from fdda_addon.core.errors import RigError
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.evaluation.run import EvaluationSettings, evaluate
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.runtime.binding import model_disabled
from fdda_addon.scene.scene_rig import SceneRig, find_rig
from fdda_addon.timing.benchmark import benchmark

from .scene_state import assert_same_state, drain, fresh_elbow, scene_state, set_unusual_state


@pytest.fixture
def disarranged() -> SceneRig:
    rig = fresh_elbow()
    set_unusual_state(rig)
    return rig


@pytest.fixture
def before(disarranged) -> dict:
    state = scene_state(disarranged)
    assert state["frame"] == (7, 0.25) and state["animation"][:3] == ("other", state["animation"][1], True)
    return state


RECORDING = RecordingSettings(poses=8, actions=("elbow_wave",))
EVALUATION = EvaluationSettings(poses=8, actions=("elbow_wave",), range_scales=(2.0,))


def test_a_disarranged_scene_is_not_at_rest(disarranged, before):
    """Else the other tests would show nothing."""
    disarranged.armature_object.pose.bones["lower"].rotation_euler[0] = 0
    after = scene_state(disarranged)
    assert after["pose"] != before["pose"]
    with pytest.raises(AssertionError):
        assert_same_state({"positions": before["positions"]}, after)


def test_recording_to_the_end(disarranged, before, tmp_path):
    drain(record(disarranged, tmp_path / "r", RECORDING))
    assert_same_state(before, scene_state(disarranged))


@pytest.mark.parametrize("step", [1, 7, 11, 12])
def test_recording_that_is_closed(disarranged, before, tmp_path, step):
    drain(record(disarranged, tmp_path / "r", RECORDING), stop_after=step)
    assert_same_state(before, scene_state(disarranged))


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_recording_that_is_broken_off(disarranged, before, tmp_path, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(RecordingWriter, "append", fail)
    with pytest.raises(error):
        drain(record(disarranged, tmp_path / "r", RECORDING))
    assert_same_state(before, scene_state(disarranged))
    assert not (tmp_path / "r").exists()


def test_recording_with_an_action_that_is_not_there(disarranged, before, tmp_path):
    with pytest.raises(RigError):
        drain(record(disarranged, tmp_path / "r", RecordingSettings(actions=("none",))))
    assert_same_state(before, scene_state(disarranged))


def test_an_armature_without_animation_stays_without(tmp_path):
    rig = fresh_elbow()
    rig.armature_object.animation_data_clear()
    before = scene_state(rig)
    drain(record(rig, tmp_path / "r", RECORDING))
    assert rig.armature_object.animation_data is None
    assert_same_state(before, scene_state(rig))


def test_animation_without_an_action_stays_without(tmp_path):
    rig = fresh_elbow()
    rig.armature_object.animation_data.action = None
    before = scene_state(rig)
    drain(record(rig, tmp_path / "r", RECORDING))
    assert_same_state(before, scene_state(rig))


@pytest.mark.skipif(bpy.app.version < (4, 4, 0), reason="no slots")
def test_an_action_without_a_slot_stays_without(disarranged, tmp_path):
    disarranged.armature_object.animation_data.action_slot = None
    before = scene_state(disarranged)
    drain(record(disarranged, tmp_path / "r", RECORDING))
    assert disarranged.armature_object.animation_data.action_slot is None
    assert_same_state(before, scene_state(disarranged))


def test_tweak_mode_is_refused_and_left_alone(disarranged, tmp_path):
    """In it Blender takes no other action; half borrowed would be worse than refused."""
    animation = disarranged.armature_object.animation_data
    animation.action = None
    animation.nla_tracks[0].select = animation.nla_tracks[0].strips[0].select = True
    animation.use_tweak_mode = True
    assert animation.use_tweak_mode
    before = scene_state(disarranged)
    with pytest.raises(RigError, match="'elbow_rig' is in tweak mode of the NLA editor; leave it first"):
        drain(record(disarranged, tmp_path / "r", RECORDING))
    assert_same_state(before, scene_state(disarranged))


def test_hidden_objects_are_refused_by_name(disarranged, tmp_path):
    disarranged.mesh_object.hide_viewport = True
    bpy.context.view_layer.update()
    with pytest.raises(RigError, match="'elbow' is hidden, so Blender does not evaluate it"):
        drain(record(disarranged, tmp_path / "r", RECORDING))


@pytest.mark.parametrize("name", ["elbow", "elbow_rig"])
def test_edit_mode_is_refused(disarranged, tmp_path, name):
    bpy.context.view_layer.objects.active = bpy.data.objects[name]
    bpy.ops.object.mode_set(mode="EDIT")
    with pytest.raises(RigError, match="'elbow' or its armature is in edit mode; leave it first"):
        drain(record(disarranged, tmp_path / "r", RECORDING))


def test_rest_position_is_refused(disarranged, tmp_path):
    disarranged.armature_object.data.pose_position = "REST"
    with pytest.raises(RigError, match="'elbow_rig' shows its rest position; set it to pose"):
        drain(record(disarranged, tmp_path / "r", RECORDING))


def test_an_armature_modifier_that_is_off_is_refused(disarranged, tmp_path):
    disarranged.mesh_object.modifiers["Armature"].show_viewport = False
    with pytest.raises(RigError, match="The Armature modifier of 'elbow' is switched off in the viewport"):
        drain(record(disarranged, tmp_path / "r", RECORDING))


@pytest.mark.parametrize("step", [None, 3, 12])
def test_evaluating(rig, elbow, step):
    set_unusual_state(rig)
    before = scene_state(rig)
    drain(evaluate(rig, elbow.model, EVALUATION), stop_after=step)
    assert_same_state(before, scene_state(rig))


@pytest.mark.parametrize("step", [None, 2])
def test_timing(rig, elbow, step):
    set_unusual_state(rig)
    before = scene_state(rig)
    drain(benchmark(rig, elbow.model, 5), stop_after=step)
    assert_same_state(before, scene_state(rig))


def test_timing_a_bound_rig_that_has_no_action(bound, elbow):
    rig = find_rig()
    rig.armature_object.animation_data_clear()
    before = scene_state(rig)
    assert before["binding"] == (True, "FDDA", "")
    with model_disabled(rig.mesh_object):
        drain(benchmark(rig, elbow.model, 5))
    assert_same_state(before, scene_state(rig))
