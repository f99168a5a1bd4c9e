# SPDX-License-Identifier: GPL-3.0-or-later
"""The frame profile: the parts of a frame, the bones with the slowest constraints, and the restored scene."""

import json
from types import SimpleNamespace

import bpy
import pytest

from blend_fixtures.characters.bones import NewBone, add_bones
from fdda_addon.operators.frame_profile import last_profile
from fdda_addon.panels.frame_profile import draw_profile
from fdda_addon.scene.scene_rig import SceneRig
from fdda_addon.timing.bone_groups import BoneGroup, find_expensive_groups, mutables_by_bone
from fdda_addon.timing.durations import ARMATURE_SCENE_NAME, Duration, temporary_armature_scene
from fdda_addon.timing.frame_profile import BONES, MODIFIER, REST, FrameProfile, profile_frame

from .conftest import run
from .drawing import Layout
from .scene_state import assert_same_state, scene_state


@pytest.fixture
def slow_rig(saved: SceneRig) -> SceneRig:
    """The elbow with a slow modifier, and one bone whose constraints take nearly all time of the bones."""
    armature_object = saved.armature_object
    add_bones(armature_object, *(NewBone(f"extra.{n}", (0, 0.3, 0), (0, 0.3, 0.05), "upper", False) for n in range(12)))
    for index in range(12):
        for _ in range(400 if index == 7 else 1):
            constraint = armature_object.pose.bones[f"extra.{index}"].constraints.new("COPY_ROTATION")
            constraint.target, constraint.subtarget = armature_object, "lower"
    armature_object.pose.bones["extra.2"].constraints[0].mute = True
    saved.mesh_object.modifiers["CorrectiveSmooth"].iterations = 200
    bpy.context.view_layer.objects.active = saved.mesh_object
    bpy.context.view_layer.update()
    return saved


def profile_of(rig: SceneRig) -> FrameProfile:
    *_, profile = profile_frame(rig)
    return profile


def test_the_parts_add_up_to_the_frame_and_the_slow_modifier_is_the_largest(slow_rig):
    before = scene_state(slow_rig)
    profile = profile_of(slow_rig)
    assert_same_state(before, scene_state(slow_rig))
    assert ARMATURE_SCENE_NAME not in bpy.data.scenes
    assert all(
        constraint.mute == (bone.name == "extra.2")
        for bone in slow_rig.armature_object.pose.bones
        for constraint in bone.constraints
    )
    parts = {(part.kind, part.name): part.duration.median for part in profile.parts}
    assert set(parts) >= {(BONES, ""), (MODIFIER, "CorrectiveSmooth"), (MODIFIER, "Armature"), (REST, "")}
    assert parts[MODIFIER, "CorrectiveSmooth"] > 0.4 * profile.frame.median
    assert profile.total == pytest.approx(profile.frame.median, rel=0.3)
    assert profile.model_limit == pytest.approx(
        parts[MODIFIER, "CorrectiveSmooth"] + parts[MODIFIER, "Armature"], rel=1e-6
    )
    assert profile.model_saving < profile.model_limit


def test_the_bone_with_the_slow_constraints_is_found(slow_rig):
    frames = range(1, 30)
    with temporary_armature_scene(slow_rig.armature_object) as scene:
        bone = slow_rig.armature_object.pose.bones["lower"]
        for frame in frames:
            bone.rotation_euler[0] = frame / 20
            bone.keyframe_insert("rotation_euler", frame=frame)
        search = find_expensive_groups(slow_rig.armature_object, scene, frames)
        while True:
            try:
                next(search)
            except StopIteration as stop:
                groups = stop.value
                break
    assert groups[0].bones == ("extra.7",) and groups[0].constraints == 400
    assert groups[0].title == "extra.7: 400 constraints"


def test_drivers_belong_to_their_bones_and_muted_constraints_are_left_out(slow_rig):
    slow_rig.armature_object.pose.bones["extra.3"].driver_add("location", 0)
    slow_rig.armature_object.driver_add("hide_render")
    mutables = mutables_by_bone(slow_rig.armature_object)
    assert {name: len(items) for name, items in mutables.items()} == {
        **dict.fromkeys(("upper", "lower"), 1),
        **{f"extra.{n}": 1 for n in range(12) if n not in (2, 7)},
        "extra.3": 2,
        "extra.7": 400,
        "": 1,
    }


@pytest.mark.parametrize(
    ("group", "title"),
    [
        (BoneGroup(("a",), 1, 0, Duration(1, 0)), "a: 1 constraint"),
        (BoneGroup(("a", "b", "c"), 2, 3, Duration(1, 0)), "a to c, 3 bones: 2 constraints, 3 drivers"),
        (BoneGroup(("",), 0, 1, Duration(1, 0)), "Properties: 1 driver"),
    ],
)
def test_groups_are_described(group, title):
    assert group.title == title


def test_a_duration_is_the_median_with_half_the_distance_of_the_quartiles():
    assert Duration.of([5.0, 1.0, 2.0, 3.0, 4.0]) == Duration(3.0, 1.0)
    assert Duration.of([-2.0, -1.0, 0.0]).median == 0, "a difference within the noise is no negative time"


def test_the_verb_writes_the_profile(elbow_files, tmp_path, capfd):
    path = tmp_path / "profile.json"
    assert run("benchmark", elbow_files.rig, "--profile", "--json", path) == 0
    profile = json.loads(path.read_text())["profile"]
    assert {part["kind"] for part in profile["parts"]} >= {"bones", "modifier", "rest"}
    assert profile["frame"]["median"] > 0 and profile["frame"]["spread"] >= 0
    output = capfd.readouterr().out
    assert "A frame takes" in output and "A model could save" in output


@pytest.mark.parametrize("arguments", [["m.onnx", "--profile"], []])
def test_a_model_or_the_profile_is_measured(elbow_files, tmp_path, capfd, arguments):
    assert run("benchmark", elbow_files.rig, *arguments, "--json", tmp_path / "p.json") == 2
    assert "Give a model to measure, or --profile without a model." in capfd.readouterr().err


def test_the_button_stores_the_profile(slow_rig):
    assert last_profile(slow_rig.mesh_object) is None
    assert bpy.ops.fdda.profile_frame() == {"FINISHED"}
    assert last_profile(slow_rig.mesh_object).vertices == len(slow_rig.mesh_object.data.vertices)


def test_an_armature_in_rest_position_is_not_profiled(saved):
    saved.armature_object.data.pose_position = "REST"
    with pytest.raises(RuntimeError, match="The armature 'elbow_rig' shows its rest position; set it to pose"):
        bpy.ops.fdda.profile_frame()


def test_a_bound_model_does_not_play_while_its_rig_is_profiled(bound_elbow):
    bpy.context.view_layer.objects.active = bound_elbow
    assert bpy.ops.fdda.profile_frame() == {"FINISHED"}
    assert bound_elbow.fdda.mode == "FDDA" and not bound_elbow.fdda.status
    parts = {part.name for part in last_profile(bound_elbow).parts if part.kind == MODIFIER}
    assert parts == {"Armature", "CorrectiveSmooth"}


def test_the_sidebar_draws_a_bar_for_each_part(slow_rig):
    assert bpy.ops.fdda.profile_frame() == {"FINISHED"}
    profile, drawn = last_profile(slow_rig.mesh_object), []
    context = SimpleNamespace(region=SimpleNamespace(width=300), preferences=bpy.context.preferences)
    draw_profile(Layout(drawn), context, slow_rig)
    texts = [element.text for element in drawn]
    assert f"Frame Profile ({profile.frame.median:.1f} ms)" in texts
    assert f"{profile.parts[0].title}" in texts and f"{profile.parts[0].duration} ms" in texts
    assert profile.savings_sentences()[0].split(" ms")[0] in " ".join(texts)
