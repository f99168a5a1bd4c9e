# SPDX-License-Identifier: GPL-3.0-or-later
"""Surfaces that depend on time are refused, unless the cause is a control; numbers without a range are named."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import in_time, targets
from blend_fixtures.characters.base import link, tube
from blend_fixtures.characters.bones import NewBone, add_bones
from blend_fixtures.characters.controls import add_cast, drive_by_property
from fdda_addon.core.errors import RigError
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.rig_check import check_recordable_rig
from fdda_addon.recording.run import record
from fdda_addon.rig import time_inputs
from fdda_addon.rig.pose_setter import TargetSettings
from fdda_addon.scene.control_reader import ControlReader
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from ..conftest import ELBOW, evaluated_positions
from ..modifiers import FEW_POSES, assert_refused, build_rig
from ..scene_state import assert_same_state, drain, scene_state

APART = 1e-4
"""Meters by which a surface differs between two frames, at the least, so that a case is one."""

SURFACE = "The surface of 'elbow' changes with time through {}, so it does not follow from the pose; {}."

FACTOR = "'modifiers[\"Smooth\"].factor' of 'elbow'"

STRENGTH = 'mesh_object/modifiers["Smooth"].factor'

MUTE = "mute it, or let it read a number that is a control"

READS = f"the driver of {FACTOR}, which reads the frame", MUTE


def keyed(path: str, owner: str, control: str) -> tuple[str, str]:
    words = f"the keys of '{path}' of '{owner}'"
    return (
        words,
        f"name what they set as a control (--extra-input '{control}'), or remove them" if control else "remove them",
    )


CASES = {
    in_time.keyed_strength: keyed('modifiers["Smooth"].factor', "elbow", f"{STRENGTH}=0:1"),
    in_time.strength_in_the_nla: keyed('modifiers["Smooth"].factor', "elbow", f"{STRENGTH}=0:1"),
    in_time.driven_by_frame: READS,
    in_time.driven_by_the_scene: READS,
    in_time.driven_by_the_context: READS,
    in_time.through_a_property: ("the driver of '[\"softness\"]' of 'elbow', which reads the frame", MUTE),
    in_time.keyed_property_without_a_range: keyed('["soft"]', "elbow_rig", 'armature_object/["soft"]=0:1'),
    in_time.property_of_the_scene: keyed('["soft"]', "Scene", ""),
    in_time.keyed_lattice: keyed("location", "lattice", "object:lattice/location[2]=0:0.05"),
    in_time.hook_on_a_moving_parent: keyed("location", "mover", "object:mover/location[2]=0:0.05"),
    in_time.hook_that_copies_what_moves: keyed("location", "mover", "object:mover/location[2]=0:0.3"),
    in_time.waving_cage: (
        "the modifier 'Wave' of 'body', which changes with time",
        "switch it off in the viewport, or remove it",
    ),
    in_time.keyed_texture: keyed(
        "noise_scale", "clouds", 'mesh_object/modifiers["Displace"].texture.noise_scale=0.05:0.5'
    ),
    in_time.keyed_nodes: keyed(
        'nodes["Vector Math.001"].inputs[3].default_value',
        "Ripple",
        'mesh_object/modifiers["Ripple"].node_group.nodes["Vector Math.001"].inputs[3].default_value=0:0.05',
    ),
    in_time.nodes_that_read_a_mover: keyed("location", "mover", "object:mover/location[2]=0:0.05"),
    in_time.second_armature_whose_rotation_is_driven: (
        "the driver of 'pose.bones[\"muscle\"].rotation_euler' of 'muscle_rig', which reads the frame",
        MUTE,
    ),
}  # fmt: skip

HELD = {
    in_time.keyed_property_without_a_range,
    in_time.through_a_property,
    in_time.second_armature_whose_rotation_is_driven,
}
"""Characters with a property that changes over time. It is a control, or the action that keys it is not played."""


def shown_in_frames(rig: SceneRig) -> list[np.ndarray]:
    """Return the surface of one bent pose at frames 1 and 30."""
    rig.armature_object.animation_data.action = None
    rig.armature_object.pose.bones["lower"].rotation_euler[0] = 1.0
    found = []
    for frame in (1, 30):
        bpy.context.scene.frame_set(frame)
        found.append(evaluated_positions(rig.mesh_object))
    return found


@pytest.mark.parametrize("build", CASES, ids=lambda build: build.__name__)
def test_a_surface_that_changes_with_time_is_refused_with_the_cause(build, loose_model, tmp_path):
    rig, sentence = build_rig(build), SURFACE.format(*CASES[build])
    assert_refused(rig, loose_model, tmp_path / "recording", sentence)
    if build is not in_time.keyed_property_without_a_range:
        assert np.abs(np.subtract(*shown_in_frames(rig))).max() > APART


@pytest.mark.parametrize("build", [build for build in CASES if build not in HELD], ids=lambda build: build.__name__)
def test_changes_with_time_are_also_detected_in_a_held_pose(build, tmp_path, monkeypatch):
    """Use the same characters, but skip the analysis of keys, drivers and modifiers."""
    for analysis in ("time_inputs", "_time_modifiers"):
        monkeypatch.setattr(time_inputs, analysis, lambda *_: ())
    rig = build_rig(build)
    before = scene_state(rig)
    with pytest.raises(RigError, match=r"The surface of 'elbow' differs by [\d.e+]+ mm between frames 1 and \d+ in"):
        drain(record(rig, tmp_path / "recording", FEW_POSES))
    assert_same_state(before, scene_state(rig))
    assert not (tmp_path / "recording").exists()


THICK = 'object:lattice/data.shape_keys.key_blocks["thick"].value'

MUSCLE = 'object:muscle_rig/pose.bones["muscle"].rotation_euler[{}]'

NODE = 'mesh_object/modifiers["Ripple"].node_group.nodes["Vector Math.001"].inputs[3].default_value'

PLAYED = {
    in_time.keyed_shape: ((), {f'shape_keys/key_blocks["{name}"].value' for name in ("flexed", "thin")}),
    in_time.keyed_shape_of_a_lattice: ((), {THICK}),
    in_time.keyed_property: ((), {'mesh_object/["softness"]'}),
    in_time.second_armature_with_an_action: ((), {MUSCLE.format(0), MUSCLE.format(2)}),
    in_time.keyed_strength: (
        ('mesh_object/modifiers["Smooth"].factor=0:1',),
        {'mesh_object/modifiers["Smooth"].factor'},
    ),
    in_time.keyed_evaluation_time: ((), {"shape_keys/eval_time"}),
    in_time.keyed_lattice: (("object:lattice/location[2]=0:0.05",), {"object:lattice/location[2]"}),
    in_time.keyed_nodes: ((f"{NODE}=0:0.05",), {NODE}),
}


@pytest.mark.parametrize("build", PLAYED, ids=lambda build: build.__name__)
def test_keyed_controls_are_accepted(build, tmp_path):
    """The keyed property is detected or named as a control and sampled; recording does not change its keys."""
    rig, (named, expected) = build_rig(build), PLAYED[build]
    settings = RecordingSettings(poses=8, influence_poses=1, extra_inputs=named)
    assert check_recordable_rig(rig, settings).problems == ()
    before = scene_state(rig)
    drain(record(rig, tmp_path / "recording", settings))
    assert_same_state(before, scene_state(rig))
    recording = read_recording(tmp_path / "recording")
    names = [control.name for control in recording.rig.controls]
    assert set(names) == expected
    assert np.ptp(recording.controls, axis=0).min() > 0, "each takes many values, whatever keys it has"
    told = ControlReader(rig, recording.rig.controls)
    at_frames = []
    for frame in (1, 30):
        bpy.context.scene.frame_set(frame)
        at_frames.append(told.read(rig, bpy.context.evaluated_depsgraph_get()))
    assert not np.array_equal(*at_frames), "the keys are played to the model"


def test_a_shape_key_that_the_frame_drives_is_an_input(tmp_path):
    """Random poses set its value without the driver."""
    rig = build_rig(in_time.shape_driven_by_frame)
    settings = RecordingSettings(poses=8, influence_poses=1)
    assert check_recordable_rig(rig, settings).problems == ()
    drain(record(rig, tmp_path / "recording", settings))
    recording = read_recording(tmp_path / "recording")
    assert [control.name for control in recording.rig.controls] == ['shape_keys/key_blocks["flexed"].value']
    assert np.ptp(recording.controls) > 0.2
    assert not rig.mesh_object.data.shape_keys.animation_data.drivers[0].mute


@pytest.mark.parametrize("kind", ["action", "driver", "frame"])
def test_a_target_that_moves_with_time_is_recorded_frame_by_frame(kind, tmp_path):
    """Random poses of the target are refused; frames of an action are recorded as for a cache."""
    flesh = targets.target_copy()
    if kind == "action":
        second_armature_on(flesh)
        words = "the keys of 'pose.bones[\"muscle\"].rotation_euler' of 'muscle_rig'"
    else:
        driver = flesh.modifiers["Mush"].driver_add("factor").driver
        words = "the driver of 'modifiers[\"Mush\"].factor' of 'flesh', which reads the frame"
        driver.expression = "frame / 30"
        if kind == "driver":
            variable = driver.variables.new()
            variable.name, variable.targets[0].id_type = "soft", "SCENE"
            variable.targets[0].id, variable.targets[0].data_path = bpy.context.scene, "frame_current"
            driver.expression = "soft / 30"
    rig, target = find_rig(ELBOW), TargetSettings("flesh")
    with pytest.raises(RigError) as error:
        drain(record(rig, tmp_path / "random", RecordingSettings(poses=4, target=target)))
    assert str(error.value).startswith(f"The target 'flesh' follows frames ({words}), so it cannot show random poses;")
    settings = RecordingSettings(poses=0, actions=("elbow_wave",), target=target)
    drain(record(rig, tmp_path / "frames", settings))
    assert read_recording(tmp_path / "frames").info.target.follows == "frames"


def second_armature_on(flesh: bpy.types.Object) -> None:
    """Add a second armature that deforms a target and is rotated by an action."""
    muscles = link(bpy.data.objects.new("muscle_rig", bpy.data.armatures.new("muscle_rig")))
    add_bones(muscles, NewBone("muscle", (0.1, 0.0, 0.0), (0.1, 0.0, 0.1)))
    flesh.vertex_groups.new(name="muscle").add(range(60), 1.0, "REPLACE")
    flesh.modifiers.new("Muscles", "ARMATURE").object = muscles
    in_time.insert_keys(muscles.pose.bones["muscle"], "rotation_euler", (0.0, 0.0, 0.0), (0.3, 0.0, 0.0))


@pytest.mark.parametrize("build", in_time.HARMLESS, ids=lambda build: build.__name__)
def test_surfaces_that_depend_on_the_pose_alone_are_recorded(build, tmp_path):
    rig = build_rig(build)
    assert check_recordable_rig(rig).problems == ()
    drain(record(rig, tmp_path / "recording", FEW_POSES))


def notes_of_recording(folder: Path, *controls: str) -> str:
    settings = RecordingSettings(poses=4, influence_poses=1, extra_inputs=controls)
    return " ".join(step.note for step in record(find_rig("elbow"), folder / "recording", settings))


def drive_strength(owner: bpy.types.ID, path: str) -> None:
    """Let the strength of a modifier of the tube follow the number at a path, from 0 to 1."""
    drive_by_property(add_cast(bpy.data.objects["elbow"]), "factor", owner, path)
    bpy.data.objects["elbow"].animation_data.drivers[0].driver.expression = "min(max(value, 0), 1)"
    bpy.context.view_layer.update()


@pytest.mark.parametrize(
    ("value", "limits", "note"),
    [
        (0.0, (-10_000.0, 10_000.0), "number 'armature_object/[\"fat\"]' without a range"),
        (0.0, None, "number 'armature_object/[\"fat\"]' without a range"),
        (0, None, "number 'armature_object/[\"fat\"]' without a range"),
        (0.0, (0.0, 1.0), ""),
    ],
)
def test_a_custom_property_is_an_input_or_is_named(
    value: float, limits: tuple[float, float] | None, note: str, tmp_path: Path
):
    _, armature_object = tube()
    armature_object["fat"] = value
    if limits:
        armature_object.id_properties_ui("fat").update(min=limits[0], max=limits[1])
    armature_object.update_tag()
    drive_strength(armature_object, '["fat"]')
    notes = notes_of_recording(tmp_path)
    assert note in notes and bool(note) == ("'elbow'" in notes)
    assert armature_object["fat"] == value
    if note:
        assert "surface" not in notes_of_recording(tmp_path / "named", 'armature_object/["fat"]=0:5')


def test_other_numbers_are_named(tmp_path: Path):
    _, armature_object = tube()
    dial = bpy.data.objects.new("dial", None)
    bpy.context.scene.collection.objects.link(dial)
    drive_strength(dial, "location[0]")
    assert "number 'object:dial/location[0]' without a range" in notes_of_recording(tmp_path)
    # A driven number is no input; the number that its driver reads is.
    armature_object["strength"] = 0.0
    variable = dial.driver_add("location", 0).driver.variables.new()
    variable.targets[0].id, variable.targets[0].data_path = armature_object, '["strength"]'
    notes = notes_of_recording(tmp_path / "driven")
    assert "dial" not in notes and "number 'armature_object/[\"strength\"]' without a range" in notes
    target = bpy.data.objects["elbow"].animation_data.drivers[0].driver.variables[0].targets[0]
    target.id_type, bpy.context.scene["fat"] = "SCENE", 0.0
    target.id, target.data_path = bpy.context.scene, '["fat"]'
    assert "number '[\"fat\"] of Scene', which cannot be an input" in notes_of_recording(tmp_path / "scene")
