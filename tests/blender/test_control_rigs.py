# SPDX-License-Identifier: GPL-3.0-or-later
"""Control rigs of Rigify, and in another armature, which move the deforming bones; the slots of actions."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import rigify
from blend_fixtures.characters.base import drive, link
from blend_fixtures.elbow import ACTION
from fdda_addon.core.errors import RigError
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import skin_recording
from fdda_addon.evaluation.run import evaluate_action
from fdda_addon.poses.clip import find_clips
from fdda_addon.properties.recording_options import actions_of_rig
from fdda_addon.scene.action_slots import active_action, dependencies, slots_of_action
from fdda_addon.scene.compatibility import animation_curves
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from .baked_files import predicted_in_frames, read_baked
from .conftest import ELBOW_RIG, Trained, assert_plays, run, train
from .figure import FRAMES, WAVE, add_wave, build_figure
from .poses.test_animation_poses import mirrored, positions_in_frames, positions_of, record_and_read
from .refusals import save_elbow
from .scene_state import assert_same_state, drain, fresh_elbow, scene_state

ROOT = Path(__file__).resolve().parents[2]

MAX_ERROR_RATIO = 0.1
"""Limit for the model's error, as a ratio of linear skinning's error, on an action outside the training data."""


@pytest.fixture(scope="module", params=["BASIC_HUMAN", pytest.param("HORSE", marks=pytest.mark.slow)])
def character(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """Build a Rigify rig in another process, record it and train a model."""
    folder = tmp_path_factory.mktemp(request.param.lower())
    files = Trained(folder / "rig.blend", folder / "recording", folder / "model.onnx")
    command = [sys.executable, "-m", rigify.__name__, request.param, files.rig]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL, timeout=300)
    sample = ("--bones-to-pose", f"action:{rigify.REHEARSAL}", "--action", rigify.REHEARSAL)
    assert run("record", files.rig, files.recording, "--poses", 150, *sample) == 0
    train(files.recording, files.model, "--passes", 50)
    return files


def test_only_deforming_bones_are_joints(character: Trained):
    recording = read_recording(character.recording)
    names = recording.rig.joint_names
    assert names and all(name.startswith("DEF-") for name in names)
    sampled = {channel.name for channel in recording.info.sampling.channels}
    assert {"torso", "chest", "head"} <= sampled and not sampled & set(names)
    # Every deforming bone but the root has a deforming bone as its parent.
    parents = {
        name: names[joint.parent] for name, joint in zip(names, recording.rig.joints, strict=True) if joint.parent >= 0
    }
    assert len(parents) == len(names) - 1


def test_only_near_joints_influence_a_foot(character: Trained):
    """No joint of head or hands influences a foot."""
    recording = read_recording(character.recording)
    names = recording.rig.joint_names
    for partition in skin_recording(recording).partitions:
        influencing_names = {names[joint] for joint in partition.influencing}
        if "foot" in names[partition.joint] and "fore" not in names[partition.joint]:
            assert influencing_names
            assert not any(part in name for name in influencing_names for part in ("head", "neck", "forearm", "hand"))


def test_an_action_outside_the_training_data_has_small_errors(character: Trained, tmp_path: Path):
    report = tmp_path / "errors.json"
    action = ("--action", rigify.PERFORMANCE)
    assert run("evaluate", character.rig, character.model, "--json", report, "--poses", 0, *action) == 0
    (errors,) = json.loads(report.read_text())["actions"]
    assert errors["linear"]["mean"] > 1.0
    assert errors["fdda"]["mean"] < MAX_ERROR_RATIO * errors["linear"]["mean"]


def test_the_bound_character_plays_the_action(character: Trained, tmp_path: Path):
    bound_path = tmp_path / "bound.blend"
    assert run("bind", character.rig, character.model, bound_path) == 0
    bpy.ops.wm.open_mainfile(filepath=str(bound_path))
    mesh_object, armature_object = bpy.data.objects["body"], bpy.data.objects["rig"]
    armature_object.animation_data.action = bpy.data.actions[rigify.PERFORMANCE]
    shapes = []
    for frame in (1, 30, 61):
        bpy.context.scene.frame_set(frame)
        shapes.append(assert_plays(mesh_object, tmp_path / character.model.name))
    assert np.abs(shapes[0] - shapes[1]).max() > 0.01


def copy_transforms(rig: SceneRig, control: bpy.types.Object) -> None:
    for bone in rig.armature_object.pose.bones:
        constraint = bone.constraints.new("COPY_TRANSFORMS")
        constraint.target, constraint.subtarget = control, bone.name


def empty_between(rig: SceneRig, control: bpy.types.Object) -> None:
    """An empty follows the control bone, and the deforming bone follows the empty. The names of the bones differ."""
    control.data.bones["lower"].name = "control"
    empty = new_empty("handle")
    follow = empty.constraints.new("COPY_ROTATION")
    follow.target, follow.subtarget = control, "control"
    rig.armature_object.pose.bones["lower"].constraints.new("COPY_ROTATION").target = empty


def drivers(rig: SceneRig, control: bpy.types.Object) -> None:
    for axis in range(3):
        path = f'pose.bones["lower"].rotation_euler[{axis}]'
        drive(rig.armature_object.pose.bones["lower"], "rotation_euler", control, path, index=axis)


def new_empty(name: str) -> bpy.types.Object:
    return link(bpy.data.objects.new(name, None))


def play(datablock: bpy.types.ID, action: bpy.types.Action) -> None:
    animation = datablock.animation_data or datablock.animation_data_create()
    animation.action = action
    animation.action_slot = action.slots[0]


def add_control_armature(rig: SceneRig, connect: Callable = copy_transforms) -> bpy.types.Object:
    """Add a copy of the armature, which moves it, and plays another action than the armature did. Return the copy."""
    armature_object = rig.armature_object
    control = armature_object.copy()
    control.name, control.data = "control", armature_object.data.copy()
    bpy.context.scene.collection.objects.link(control)
    armature_object.animation_data_clear()
    for bone in armature_object.pose.bones:
        for constraint in list(bone.constraints):
            bone.constraints.remove(constraint)
    connect(rig, control)
    control.animation_data.action.use_fake_user = True
    control.animation_data.action = bpy.data.actions.new("other")
    for frame in (1, 5):
        control.pose.bones[0].location = (0, 0, 0.01 * frame)
        control.pose.bones[0].keyframe_insert("location", frame=frame)
    # The user has posed a bone without keys.
    control.pose.bones[0].location = (0, 0, 0.3)
    bpy.context.view_layer.update()
    return control


@pytest.mark.parametrize("connect", [copy_transforms, empty_between, drivers])
def test_an_action_of_a_control_armature_is_recorded(connect, tmp_path):
    rig = fresh_elbow()
    control = add_control_armature(rig, connect)
    before = scene_state(rig)
    recording = record_and_read(rig, tmp_path / "recording", actions=(ACTION, "other"))
    assert_same_state(before, scene_state(rig))
    assert control.animation_data.action.name == "other"
    control.pose.bones[0].location = (0, 0, 0)
    play(control, bpy.data.actions[ACTION])
    shown = positions_in_frames(rig, range(1, 31))
    assert np.ptp(shown, axis=0).max() > 0.1
    np.testing.assert_allclose(positions_of(recording)[:30], shown, atol=1e-5)


def test_a_control_armature_is_baked_and_evaluated(elbow_files, tmp_path):
    rig_file = save_elbow(tmp_path / "rig.blend", add_control_armature)
    assert run("bake", rig_file, elbow_files.model, tmp_path / "wave.abc", "--action", ACTION) == 0
    bpy.ops.wm.open_mainfile(filepath=str(rig_file))
    rig, control = find_rig(), bpy.data.objects["control"]
    evaluation = drain(evaluate_action(rig, elbow_files.model, ACTION)).held_out
    assert [action.name for action in actions_of_rig(rig)] == [ACTION, "other"]
    assert active_action(rig.armature_object, rig.mesh_object).name == "other"
    view = bpy.context.window_manager.fdda_view
    bpy.context.view_layer.objects.active = rig.mesh_object
    assert view.action == "other"
    view.action = ACTION
    assert control.animation_data.action.name == ACTION == view.action
    control.pose.bones[0].location = (0, 0, 0)
    expected = predicted_in_frames(range(1, 31), elbow_files.model)
    assert np.ptp(expected, axis=0).max() > 0.1
    np.testing.assert_allclose(evaluation.positions, positions_in_frames(rig, range(1, 31)), atol=1e-5)
    assert run("benchmark", rig_file, elbow_files.model, "--frames", 3, "--json", tmp_path / "times.json") == 0
    assert np.abs(read_baked(tmp_path / "wave.abc", range(1, 31)) - expected).max() < 1e-6


def test_strips_and_mirrored_frames_of_a_control_armature(tmp_path):
    rig = build_figure()
    wave = add_wave(rig)
    control = add_control_armature(rig)
    strip = control.animation_data.nla_tracks.new().strips.new("swing", 40, wave)
    control.animation_data.action = None
    control.pose.bones[0].location = (0, 0, 0)
    shown = positions_in_frames(rig, range(40, 40 + FRAMES))
    recording = record_and_read(rig, tmp_path / "strip", strips=(strip.name,), mirror=True)
    np.testing.assert_allclose(positions_of(recording)[:FRAMES], shown, atol=1e-5)
    np.testing.assert_allclose(positions_of(recording)[FRAMES:], mirrored(rig, shown), atol=1e-5)
    recording = record_and_read(rig, tmp_path / "action", actions=(WAVE,))
    np.testing.assert_allclose(positions_of(recording), shown, atol=1e-5)


def slots(rig: SceneRig, action: bpy.types.Action) -> dict[str, str]:
    """Return the identifiers of the slots that animate a rig, by the names of datablocks."""
    datablocks = dependencies(rig.armature_object, rig.mesh_object)
    return {datablock.name: slot.identifier for datablock, slot in slots_of_action(action, datablocks).items()}


def test_a_slot_animates_its_users_then_those_of_its_identifier_then_its_name():
    rig = fresh_elbow()
    control = add_control_armature(rig)
    wave = bpy.data.actions[ACTION]
    wave.slots[0].name_display = "unknown"
    assert slots(rig, wave) == {"control": "OBunknown"}, "the bones of the armature are overridden"
    rig.armature_object.pose.bones["upper"].constraints[0].influence = 0.5
    rig.armature_object.pose.bones["lower"].constraints[0].influence = 0.5
    with pytest.raises(RigError, match=r"may be for 'control' or 'elbow_rig'; assign the action to one of them"):
        slots(rig, wave)
    other = bpy.data.actions["other"]
    wave.slots[0].name_display, other.slots[0].name_display = ELBOW_RIG, "unknown"
    assert slots(rig, wave) == {ELBOW_RIG: f"OB{ELBOW_RIG}"}
    other.slots[0].name_display = ELBOW_RIG
    assert slots(rig, wave) == {"control": f"OB{ELBOW_RIG}"}, "as it plays a slot with this identifier"
    play(rig.armature_object, wave)
    assert slots(rig, wave) == {ELBOW_RIG: f"OB{ELBOW_RIG}"}
    play(control, wave)
    assert slots(rig, wave) == dict.fromkeys((ELBOW_RIG, "control"), f"OB{ELBOW_RIG}")


def test_objects_that_share_a_slot_are_all_animated():
    """Two empties play a slot of one action, and another action has a slot with its identifier."""
    rig = fresh_elbow()
    bones = rig.armature_object.pose.bones
    empties = [new_empty(name) for name in ("first", "second")]
    walk, jump = bpy.data.actions.new("walk"), bpy.data.actions.new("jump")
    for action in (walk, jump):
        slot = action.slots.new("OBJECT", "handles")
        for empty in empties:
            animation = empty.animation_data or empty.animation_data_create()
            animation.action, animation.action_slot = action, slot
        empties[0].keyframe_insert("location", frame=1)
    for bone, empty in zip(bones, empties, strict=True):
        bone.constraints.new("COPY_LOCATION").target = empty
    assert slots(rig, walk) == slots(rig, jump) == {"first": "OBhandles", "second": "OBhandles"}
    new_empty("third").location = (1, 0, 0)
    play(bpy.data.objects["third"], walk)
    assert slots(rig, walk) == {"first": "OBhandles", "second": "OBhandles"}


def test_two_characters_in_a_file_have_their_own_slots():
    """Each has a control armature with the same bones, and one action has slots for both."""
    rig = fresh_elbow()
    control = add_control_armature(rig)
    copies = {}
    for source in (control, rig.armature_object, rig.mesh_object):
        copies[source] = source.copy()
        bpy.context.scene.collection.objects.link(copies[source])
    other = SceneRig(copies[rig.mesh_object], copies[rig.armature_object])
    other.mesh_object.parent = other.mesh_object.modifiers["Armature"].object = other.armature_object
    for bone in other.armature_object.pose.bones:
        bone.constraints[0].target = copies[control]
    play(control, bpy.data.actions["other"])
    copies[control].animation_data_clear()
    duel = bpy.data.actions.new("duel")
    for fighter in (control, copies[control]):
        fighter.animation_data_create().action = duel
        fighter.animation_data.action_slot = duel.slots.new("OBJECT", fighter.name)
        fighter.pose.bones["lower"].keyframe_insert("rotation_euler", frame=1)
        fighter.animation_data.action = None
    assert slots(rig, duel) == {"control": "OBcontrol"}
    assert slots(other, duel) == {"control.001": "OBcontrol.001"}
    play(control, bpy.data.actions[ACTION])
    assert slots(other, bpy.data.actions[ACTION]) == {"control.001": f"OB{ELBOW_RIG}"}, "an action of the first one"


def test_actions_without_effect_on_a_rig_are_refused():
    rig = fresh_elbow()
    add_control_armature(rig)
    wave, camera = bpy.data.actions[ACTION], new_empty("camera")
    play_elsewhere = bpy.data.actions.new("fly")
    camera.animation_data_create().action = play_elsewhere
    camera.keyframe_insert("location", frame=1)
    bpy.data.actions.new("nothing")
    assert not {"fly", "nothing"} & {action.name for action in actions_of_rig(rig)}
    start = (
        r"The action '{}' animates neither 'elbow_rig' nor anything that moves 'elbow': {}; choose another action, or"
    )
    for curve in animation_curves(wave):
        curve.mute = True
    for name, reason in (
        ("fly", "its slots are for something else: 'OBcamera'"),
        ("nothing", "it has no F-curves"),
        (ACTION, "its F-curves are muted"),
    ):
        with pytest.raises(RigError, match=start.format(name, reason)):
            find_clips([rig], [name])
