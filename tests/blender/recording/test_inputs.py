# SPDX-License-Identifier: GPL-3.0-or-later
"""What changes a surface besides the pose is an input, or is named: time, and numbers without a range."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import controls, stacks, targets
from blend_fixtures.characters.base import add_key, bulge, drive, link, tube
from blend_fixtures.characters.bones import NewBone, add_bones, remove_constraints
from blend_fixtures.characters.controls import add_cast, add_property
from blend_fixtures.characters.skinning import two_armatures
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


def insert_keys(owner: bpy.types.bpy_struct, path: str, first_value: object, last_value: object) -> None:
    """Insert keyframes of a property at frames 1 and 30, and go to frame 1."""
    for frame, value in ((1, first_value), (30, last_value)):
        if path.startswith('["'):
            owner[path[2:-2]] = value
        else:
            setattr(owner, path, value)
        owner.keyframe_insert(path, frame=frame)
    bpy.context.scene.frame_set(1)


def smoothed_tube() -> bpy.types.Modifier:
    """Build a tube with a Smooth modifier after the skinning; return the modifier."""
    stacks.smooth()
    return bpy.data.objects[ELBOW].modifiers["Smooth"]


def keyed_strength() -> None:
    insert_keys(smoothed_tube(), "factor", 0.0, 1.0)


def strength_in_the_nla() -> None:
    insert_keys(smoothed_tube(), "factor", 0.0, 1.0)
    animation = bpy.data.objects[ELBOW].animation_data
    action, slot = animation.action, animation.action_slot
    animation.action = None
    strip = animation.nla_tracks.new().strips.new("strip", 1, action)
    strip.action_slot = slot


def driven_by_frame() -> None:
    smoothed_tube().driver_add("factor").driver.expression = "min(1, frame / 30)"


def shape_driven_by_frame() -> None:
    mesh_object, _ = tube()
    add_key(mesh_object, "flexed", bulge).driver_add("value").driver.expression = "min(1, frame / 30)"


def keyed_evaluation_time() -> None:
    stacks.absolute_shape_keys()
    keys = bpy.data.objects[ELBOW].data.shape_keys
    keys.driver_remove("eval_time")
    insert_keys(keys, "eval_time", 0.0, 10.0)


def keyed_lattice() -> None:
    stacks.lattice()
    insert_keys(bpy.data.objects["lattice"], "location", (0.25, 0.0, 0.0), (0.25, 0.0, 0.05))


def hook_on_a_moving_parent() -> None:
    stacks.hook()
    parent = link(bpy.data.objects.new("mover", None))
    handle = bpy.data.objects["handle"]
    handle.parent = parent
    insert_keys(parent, "location", (0.0, 0.0, 0.0), (0.0, 0.0, 0.05))


def hook_that_copies_what_moves() -> None:
    stacks.hook()
    mover, handle = link(bpy.data.objects.new("mover", None)), bpy.data.objects["handle"]
    insert_keys(mover, "location", (0.0, 0.0, 0.0), (0.0, 0.0, 0.3))
    handle.constraints.new("COPY_LOCATION").target = mover


def waving_cage() -> None:
    stacks.surface_deform()
    wave = bpy.data.objects["body"].modifiers.new("Wave", "WAVE")
    wave.height, wave.width, wave.narrowness = 0.05, 0.2, 5.0


def keyed_texture() -> None:
    stacks.displace()
    modifier = bpy.data.objects[ELBOW].modifiers["Displace"]
    modifier.texture, modifier.strength = bpy.data.textures.new("clouds", "CLOUDS"), 0.05
    insert_keys(modifier.texture, "noise_scale", 0.05, 0.5)


def keyed_nodes() -> None:
    stacks.geometry_nodes()
    group = bpy.data.objects[ELBOW].modifiers["Ripple"].node_group
    scale = next(node for node in group.nodes if getattr(node, "operation", "") == "SCALE")
    insert_keys(scale.inputs["Scale"], "default_value", 0.0, 0.05)


def nodes_that_read_a_mover() -> None:
    stacks.geometry_nodes()
    group = bpy.data.objects[ELBOW].modifiers["Ripple"].node_group
    mover, info = link(bpy.data.objects.new("mover", None)), group.nodes.new("GeometryNodeObjectInfo")
    info.inputs["Object"].default_value = mover
    group.links.new(info.outputs["Location"], group.nodes["Set Position"].inputs["Offset"])
    insert_keys(mover, "location", (0.0, 0.0, 0.0), (0.0, 0.0, 0.05))


def second_armature_whose_rotation_is_driven() -> None:
    two_armatures()
    bone = bpy.data.objects["muscle_rig"].pose.bones["muscle"]
    bone.driver_add("rotation_euler", 0).driver.expression = "frame / 60"


def keyed_shape() -> None:
    controls.free_shape_keys()
    block = bpy.data.objects[ELBOW].data.shape_keys.key_blocks["flexed"]
    insert_keys(block, "value", 0.0, 1.0)


def keyed_property() -> None:
    controls.modifier_strength()
    insert_keys(bpy.data.objects[ELBOW], '["softness"]', 0.0, 1.0)


def second_armature_with_an_action() -> None:
    two_armatures()
    insert_keys(
        bpy.data.objects["muscle_rig"].pose.bones["muscle"], "rotation_euler", (-0.3, 0.0, 0.0), (0.3, 0.0, 0.0)
    )


def one_value_in_all_frames() -> None:
    insert_keys(smoothed_tube(), "factor", 0.5, 0.5)


def a_hidden_modifier_with_keys() -> None:
    modifier = smoothed_tube()
    insert_keys(modifier, "factor", 0.0, 1.0)
    modifier.show_viewport = False


def a_live_modifier_with_keys() -> None:
    stacks.subdivided()
    insert_keys(bpy.data.objects[ELBOW].modifiers["Thickness"], "thickness", 0.0, 0.1)


def what_moves_nothing() -> None:
    modifier, mesh_object = smoothed_tube(), bpy.data.objects[ELBOW]
    insert_keys(modifier, "show_render", False, True)
    insert_keys(mesh_object, "hide_render", False, True)
    insert_keys(mesh_object, "pass_index", 0, 5)
    mesh_object.driver_add("color", 0).driver.expression = "frame / 30"


def a_muted_shape_with_keys() -> None:
    keyed_shape()
    bpy.data.objects[ELBOW].data.shape_keys.key_blocks["flexed"].mute = True


def a_lattice_that_is_carried() -> None:
    """The whole character and its lattice are children of an animated empty."""
    stacks.lattice()
    carrier = link(bpy.data.objects.new("carrier", None))
    for name in ("elbow_rig", "lattice"):
        bpy.data.objects[name].parent = carrier
    insert_keys(carrier, "location", (0.0, 0.0, 0.0), (5.0, 1.0, 0.0))


def bones_that_move_with_time() -> None:
    """Bones that change with time change the pose, which is an input of the model."""
    _, armature_object = tube()
    bone = armature_object.pose.bones["upper"]
    remove_constraints(bone)
    bone.driver_add("rotation_euler", 2).driver.expression = "frame / 60"
    copy = armature_object.pose.bones["lower"].constraints.new("COPY_ROTATION")
    copy.target, copy.subtarget, copy.influence = armature_object, "upper", 0.0
    insert_keys(copy, "influence", 0.0, 1.0)


def through_a_property() -> None:
    """A property of the mesh object drives the strength, and the frame drives the property."""
    modifier, mesh_object = smoothed_tube(), bpy.data.objects[ELBOW]
    add_property(mesh_object, "softness")
    drive(modifier, "factor", mesh_object, '["softness"]')
    mesh_object.driver_add('["softness"]').driver.expression = "min(1, frame / 30)"


def keyed_property_of_the_rig() -> None:
    modifier, armature_object = smoothed_tube(), bpy.data.objects["elbow_rig"]
    armature_object["soft"] = 0.0
    drive(modifier, "factor", armature_object, '["soft"]')
    insert_keys(armature_object, '["soft"]', 0.0, 1.0)


def keyed_property_of_the_scene() -> None:
    bpy.context.scene["soft"] = 0.0
    drive(smoothed_tube(), "factor", bpy.context.scene, '["soft"]')
    insert_keys(bpy.context.scene, '["soft"]', 0.0, 1.0)


def driven_by_the_scene() -> None:
    drive(smoothed_tube(), "factor", bpy.context.scene, "frame_current", "value / 30")


def driven_by_the_context() -> None:
    driver = smoothed_tube().driver_add("factor").driver
    variable = driver.variables.new()
    variable.name, variable.type, variable.targets[0].data_path = "now", "CONTEXT_PROP", "frame_current"
    driver.expression = "now / 30"


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
    keyed_strength: keyed('modifiers["Smooth"].factor', "elbow", f"{STRENGTH}=0:1"),
    strength_in_the_nla: keyed('modifiers["Smooth"].factor', "elbow", f"{STRENGTH}=0:1"),
    driven_by_frame: READS,
    driven_by_the_scene: READS,
    driven_by_the_context: READS,
    through_a_property: ("the driver of '[\"softness\"]' of 'elbow', which reads the frame", MUTE),
    keyed_property_of_the_rig: keyed('["soft"]', "elbow_rig", 'armature_object/["soft"]=0:1'),
    keyed_property_of_the_scene: keyed('["soft"]', "Scene", ""),
    keyed_lattice: keyed("location", "lattice", "object:lattice/location[2]=0:0.05"),
    hook_on_a_moving_parent: keyed("location", "mover", "object:mover/location[2]=0:0.05"),
    hook_that_copies_what_moves: keyed("location", "mover", "object:mover/location[2]=0:0.3"),
    waving_cage: (
        "the modifier 'Wave' of 'body', which changes with time",
        "switch it off in the viewport, or remove it",
    ),
    keyed_texture: keyed(
        "noise_scale", "clouds", 'mesh_object/modifiers["Displace"].texture.noise_scale=0.05:0.5'
    ),
    keyed_nodes: keyed(
        'nodes["Vector Math.001"].inputs[3].default_value',
        "Ripple",
        'mesh_object/modifiers["Ripple"].node_group.nodes["Vector Math.001"].inputs[3].default_value=0:0.05',
    ),
    nodes_that_read_a_mover: keyed("location", "mover", "object:mover/location[2]=0:0.05"),
    second_armature_whose_rotation_is_driven: (
        "the driver of 'pose.bones[\"muscle\"].rotation_euler' of 'muscle_rig', which reads the frame",
        MUTE,
    ),
}  # fmt: skip


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
    if build is not keyed_property_of_the_rig:
        assert np.abs(np.subtract(*shown_in_frames(rig))).max() > APART


@pytest.mark.parametrize(
    "build", [keyed_strength, hook_on_a_moving_parent, waving_cage], ids=lambda build: build.__name__
)
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


MUSCLE = 'object:muscle_rig/pose.bones["muscle"].rotation_euler[{}]'

NODE = 'mesh_object/modifiers["Ripple"].node_group.nodes["Vector Math.001"].inputs[3].default_value'

PLAYED = {
    keyed_shape: ((), {f'shape_keys/key_blocks["{name}"].value' for name in ("flexed", "thin")}),
    keyed_property: ((), {'mesh_object/["softness"]'}),
    second_armature_with_an_action: ((), {MUSCLE.format(0), MUSCLE.format(2)}),
    keyed_strength: (
        ('mesh_object/modifiers["Smooth"].factor=0:1',),
        {'mesh_object/modifiers["Smooth"].factor'},
    ),
    keyed_evaluation_time: ((), {"shape_keys/eval_time"}),
    keyed_lattice: (("object:lattice/location[2]=0:0.05",), {"object:lattice/location[2]"}),
    keyed_nodes: ((f"{NODE}=0:0.05",), {NODE}),
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
    rig = build_rig(shape_driven_by_frame)
    settings = RecordingSettings(poses=8, influence_poses=1)
    assert check_recordable_rig(rig, settings).problems == ()
    drain(record(rig, tmp_path / "recording", settings))
    recording = read_recording(tmp_path / "recording")
    assert [control.name for control in recording.rig.controls] == ['shape_keys/key_blocks["flexed"].value']
    assert np.ptp(recording.controls) > 0.2
    assert not rig.mesh_object.data.shape_keys.animation_data.drivers[0].mute


@pytest.mark.parametrize("kind", ["action", "driver"])
def test_a_target_that_moves_with_time_is_recorded_frame_by_frame(kind, tmp_path):
    """Random poses of the target are refused; frames of an action are recorded as for a cache."""
    flesh = targets.target_copy()
    if kind == "action":
        muscles = link(bpy.data.objects.new("muscle_rig", bpy.data.armatures.new("muscle_rig")))
        add_bones(muscles, NewBone("muscle", (0.1, 0.0, 0.0), (0.1, 0.0, 0.1)))
        flesh.vertex_groups.new(name="muscle").add(range(60), 1.0, "REPLACE")
        flesh.modifiers.new("Muscles", "ARMATURE").object = muscles
        insert_keys(muscles.pose.bones["muscle"], "rotation_euler", (0.0, 0.0, 0.0), (0.3, 0.0, 0.0))
        words = "the keys of 'pose.bones[\"muscle\"].rotation_euler' of 'muscle_rig'"
    else:
        drive(flesh.modifiers["Mush"], "factor", bpy.context.scene, "frame_current", "value / 30")
        words = "the driver of 'modifiers[\"Mush\"].factor' of 'flesh', which reads the frame"
    rig, target = find_rig(ELBOW), TargetSettings("flesh")
    with pytest.raises(RigError) as error:
        drain(record(rig, tmp_path / "random", RecordingSettings(poses=4, target=target)))
    assert str(error.value).startswith(f"The target 'flesh' follows frames ({words}), so it cannot show random poses;")
    settings = RecordingSettings(poses=0, actions=("elbow_wave",), target=target)
    drain(record(rig, tmp_path / "frames", settings))
    assert read_recording(tmp_path / "frames").info.target.follows == "frames"


HARMLESS = (
    one_value_in_all_frames, a_hidden_modifier_with_keys, a_live_modifier_with_keys, what_moves_nothing,
    a_muted_shape_with_keys, a_lattice_that_is_carried, bones_that_move_with_time,
)  # fmt: skip


@pytest.mark.parametrize("build", HARMLESS, ids=lambda build: build.__name__)
def test_surfaces_that_depend_on_the_pose_alone_are_recorded(build, tmp_path):
    rig = build_rig(build)
    assert check_recordable_rig(rig).problems == ()
    drain(record(rig, tmp_path / "recording", FEW_POSES))


def notes_of_recording(folder: Path, *controls: str) -> str:
    settings = RecordingSettings(poses=4, influence_poses=1, extra_inputs=controls)
    return " ".join(step.note for step in record(find_rig("elbow"), folder / "recording", settings))


def drive_strength(owner: bpy.types.ID, path: str) -> None:
    """Let the strength of a modifier of the tube follow the number at a path, from 0 to 1."""
    drive(add_cast(bpy.data.objects["elbow"]), "factor", owner, path, "min(max(value, 0), 1)")
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
    dial = link(bpy.data.objects.new("dial", None))
    drive_strength(dial, "location[0]")
    assert "number 'object:dial/location[0]' without a range" in notes_of_recording(tmp_path)
    # A driven number is no input; the number that its driver reads is.
    armature_object["strength"] = 0.0
    drive(dial, "location", armature_object, '["strength"]', index=0)
    notes = notes_of_recording(tmp_path / "driven")
    assert "dial" not in notes and "number 'armature_object/[\"strength\"]' without a range" in notes
    target = bpy.data.objects["elbow"].animation_data.drivers[0].driver.variables[0].targets[0]
    target.id_type, bpy.context.scene["fat"] = "SCENE", 0.0
    target.id, target.data_path = bpy.context.scene, '["fat"]'
    assert "number '[\"fat\"] of Scene', which cannot be an input" in notes_of_recording(tmp_path / "scene")
