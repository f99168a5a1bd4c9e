# SPDX-License-Identifier: GPL-3.0-or-later
"""Recording, evaluation and benchmarks restore the scene, and refuse rest poses that cannot be trained."""

import math

import bpy
import pytest

from fdda_addon.core.errors import RigError
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.evaluation.run import evaluate
from fdda_addon.evaluation.settings import EvaluationSettings
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.rig_check import check_recordable_rig
from fdda_addon.recording.run import record
from fdda_addon.scene.mesh import mesh_positions, set_mesh_positions
from fdda_addon.scene.scene_rig import SceneRig, find_rig
from fdda_addon.timing.benchmark import benchmark

from ..figure import edit_bones
from ..scene_state import assert_same_state, drain, fresh_elbow, scene_state


def set_unusual_state(rig: SceneRig) -> None:
    """Give everything that jobs change a value that differs from its default."""
    armature_object = rig.armature_object
    animation = armature_object.animation_data
    other_action = bpy.data.actions.new("other")
    track = animation.nla_tracks.new()
    track.name = "below"
    track.strips.new("wave", 40, bpy.data.actions["elbow_wave"])
    animation.action = other_action
    for frame, angle in ((1, 0.0), (20, 0.4)):
        armature_object.pose.bones["upper"].rotation_euler[1] = angle
        armature_object.pose.bones["upper"].keyframe_insert("rotation_euler", index=1, frame=frame)
    bpy.context.scene.frame_set(7, subframe=0.25)
    # These values have no keyframes, and differ from the animated values of this frame.
    upper, lower = (armature_object.pose.bones[name] for name in ("upper", "lower"))
    upper.rotation_euler = (0.1, 0.2, 0.3)
    lower.rotation_euler[0] = 1.1
    lower.location, lower.scale = (0.01, 0, 0), (1, 1.1, 1)
    lower.rotation_quaternion = (0.5, 0.5, 0.5, 0.5)
    lower["mood"], armature_object["mood"] = 0.5, 2.0
    rig.mesh_object.modifiers.new("Off", "CAST").show_viewport = False
    rig.mesh_object.select_set(True)
    armature_object.select_set(False)
    bpy.context.view_layer.objects.active = rig.mesh_object


@pytest.fixture
def unusual_rig() -> SceneRig:
    """An elbow whose animation, pose and selection differ from all defaults."""
    rig = fresh_elbow()
    set_unusual_state(rig)
    return rig


@pytest.fixture
def before(unusual_rig) -> dict:
    """Return the state of the scene before the test."""
    state = scene_state(unusual_rig)
    assert state["frame"] == (7, 0.25) and state["animation"][:3] == ("other", state["animation"][1], True)
    return state


RECORDING_SETTINGS = RecordingSettings(poses=8, actions=("elbow_wave",))

EVALUATION_SETTINGS = EvaluationSettings(poses=8, actions=("elbow_wave",), range_scales=(2.0,))


@pytest.mark.parametrize("step", [None, 1, 7, 12])
def test_a_complete_or_canceled_recording_restores_the_scene(unusual_rig, before, tmp_path, step):
    drain(record(unusual_rig, tmp_path / "r", RECORDING_SETTINGS), stop_after=step)
    assert_same_state(before, scene_state(unusual_rig))


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_recording_with_an_error_restores_the_scene(unusual_rig, before, tmp_path, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr(RecordingWriter, "append", fail)
    with pytest.raises(error):
        drain(record(unusual_rig, tmp_path / "r", RECORDING_SETTINGS))
    assert_same_state(before, scene_state(unusual_rig))
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("missing", ["animation data", "action", "slot"])
def test_recording_assigns_no_animation(unusual_rig, tmp_path, missing):
    armature_object = unusual_rig.armature_object
    if missing == "animation data":
        armature_object.animation_data_clear()
    elif missing == "action":
        armature_object.animation_data.action = None
    else:
        armature_object.animation_data.action_slot = None
    before = scene_state(unusual_rig)
    drain(record(unusual_rig, tmp_path / "r", RECORDING_SETTINGS))
    animation = armature_object.animation_data
    assert (animation is None) == (missing == "animation data")
    assert animation is None or animation.action_slot is None
    assert_same_state(before, scene_state(unusual_rig))


def test_tweak_mode_is_refused_and_not_left(unusual_rig, tmp_path):
    """In tweak mode Blender accepts no other action, so recording could not restore the scene."""
    animation = unusual_rig.armature_object.animation_data
    animation.action = None
    animation.nla_tracks[0].select = animation.nla_tracks[0].strips[0].select = True
    animation.use_tweak_mode = True
    assert animation.use_tweak_mode
    before = scene_state(unusual_rig)
    with pytest.raises(RigError, match="'elbow_rig' is in tweak mode of the NLA editor; leave it first"):
        drain(record(unusual_rig, tmp_path / "r", RECORDING_SETTINGS))
    assert_same_state(before, scene_state(unusual_rig))


def edit(name: str):
    def begin(_rig) -> None:
        bpy.context.view_layer.objects.active = bpy.data.objects[name]
        bpy.ops.object.mode_set(mode="EDIT")

    return begin


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda rig: setattr(rig.mesh_object, "hide_viewport", True), "'elbow' is hidden, so Blender does not eval"),
        (edit("elbow"), "'elbow' or its armature is in edit mode; leave it first"),
        (edit("elbow_rig"), "'elbow' or its armature is in edit mode; leave it first"),
        (lambda rig: setattr(rig.armature_object.data, "pose_position", "REST"), "shows its rest position; set it to"),
        (
            lambda rig: setattr(rig.mesh_object.modifiers["Armature"], "show_viewport", False),
            "The Armature modifier of 'elbow' is switched off in the viewport",
        ),
    ],
    ids=["hidden", "edit mode", "edit mode of the armature", "rest position", "modifier off"],
)
def test_a_rig_that_does_not_show_its_poses_is_refused(unusual_rig, tmp_path, change, sentence):
    change(unusual_rig)
    bpy.context.view_layer.update()
    with pytest.raises(RigError, match=sentence):
        drain(record(unusual_rig, tmp_path / "r", RECORDING_SETTINGS))


@pytest.mark.parametrize("step", [None, 3, 12])
def test_an_evaluation_restores_the_scene(rig, elbow_files, step):
    set_unusual_state(rig)
    before = scene_state(rig)
    drain(evaluate(rig, elbow_files.model, EVALUATION_SETTINGS), stop_after=step)
    assert_same_state(before, scene_state(rig))


@pytest.mark.parametrize(("is_bound", "step"), [(False, None), (False, 2), (True, None)])
def test_a_benchmark_restores_the_scene(elbow_files, is_bound, step):
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.bound if is_bound else elbow_files.rig))
    rig = find_rig()
    if is_bound:
        rig.armature_object.animation_data_clear()
    else:
        set_unusual_state(rig)
    before = scene_state(rig)
    assert before["binding"] == (is_bound, "FDDA" if is_bound else before["binding"][1], "")
    drain(benchmark(rig.armature_object, 5, {rig.mesh_object: elbow_files.model}), stop_after=step)
    assert_same_state(before, scene_state(rig))


def move_vertices(index: object, value: float):
    """Return a function that sets coordinates of the rest positions (V, 3)."""

    def change(rig: SceneRig) -> None:
        points = mesh_positions(rig.mesh_object.data)
        points[index] = value
        set_mesh_positions(rig.mesh_object.data, points)

    return change


def collapse_basis_key(rig: SceneRig) -> None:
    rig.mesh_object.shape_key_add(name="Basis")
    for point in rig.mesh_object.data.shape_keys.reference_key.data:
        point.co = (0, 0, 0)


def keep_one_vertex(rig: SceneRig) -> None:
    rig.mesh_object.data.clear_geometry()
    rig.mesh_object.data.vertices.add(1)


def place_armature_nowhere(rig: SceneRig) -> None:
    rig.armature_object.location.x = math.nan
    bpy.context.view_layer.update()


NOT_FINITE = "of 300 vertices of 'elbow' have coordinates that are not finite, the first is vertex"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (move_vertices((3, 1), math.nan), f"1 {NOT_FINITE} 3;"),
        (move_vertices(slice(5, 7), math.inf), f"2 {NOT_FINITE} 5; delete"),
        (
            move_vertices(slice(None), 1000.1),
            "'elbow' has no size: 300 vertices at one point in the rest pose; give the",
        ),
        (collapse_basis_key, "'elbow' has no size: 300 vertices at one point in the rest pose"),
        (keep_one_vertex, "'elbow' has no size: 1 vertex at one point in the rest pose"),
        (
            lambda rig: edit_bones(rig, lambda bones: setattr(bones["lower"], "tail", (math.nan, 0, 0))),
            "The bone 'lower' has no length or no finite place in the rest pose; give its head and its tail",
        ),
        (
            place_armature_nowhere,
            "'elbow_rig' is at no finite place; clear the location, rotation and scale of it and of its",
        ),
    ],
)
def test_a_rest_pose_without_size_or_finite_location_is_refused(change, words, tmp_path):
    rig = fresh_elbow()
    change(rig)
    (problem,) = check_recordable_rig(rig).problems
    assert problem.startswith(words)
    with pytest.raises(RigError) as error:
        drain(record(rig, tmp_path / "recording", RecordingSettings(poses=3)))
    assert str(error.value) == problem and not (tmp_path / "recording").exists()
