# SPDX-License-Identifier: GPL-3.0-or-later
"""Controls that deform a target, or that are channels of sampled bones, are inputs if they move the surface."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import targets
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.core.recording.skinned import skin_recording
from fdda_addon.scene.blend_file import save_copy

from .conftest import run

SLIDE = 'armature_object/pose.bones["slider"].location[0]'
ARM = ("--bones-to-pose", "bone:lower", "--bones-to-pose", "bone:slider")


def face() -> None:
    """The tube and its target `flesh`, which alone follows the bone `cheek`. That bone follows `slider`."""
    flesh = targets.target_copy()
    armature_object = bpy.data.objects["elbow_rig"]
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    bones = armature_object.data.edit_bones
    for name, place, parent in (("slider", 0.8, None), ("cheek", 0.35, "lower")):
        bone = bones.new(name)
        bone.head, bone.tail = (place, 0, 0), (place, 0, 0.1)
        bone.parent, bone.use_deform = parent and bones[parent], name == "cheek"
    bpy.ops.object.mode_set(mode="OBJECT")
    near = [vertex.index for vertex in flesh.data.vertices if vertex.co.x > 0.3]
    flesh.vertex_groups.new(name="cheek").add(near, 0.5, "REPLACE")
    slider, cheek = (armature_object.pose.bones[name] for name in ("slider", "cheek"))
    follow = cheek.constraints.new("COPY_LOCATION")
    follow.target, follow.subtarget, follow.use_offset = armature_object, "slider", True
    follow.owner_space = follow.target_space = "LOCAL"
    slider.lock_rotation = (True, True, True)
    limit = slider.constraints.new("LIMIT_LOCATION")
    limit.owner_space, limit.use_min_x, limit.use_max_x, limit.min_x, limit.max_x = "LOCAL", True, True, -0.05, 0.05


def recorded(tmp_path: Path, *options: object) -> Recording:
    assert run("record", tmp_path / "rig.blend", tmp_path / "recording", "--object", "elbow", *options) == 0
    return read_recording(tmp_path / "recording")


@pytest.mark.parametrize("bounds", [(-0.05, 0.05), (-0.02, 0.04)])
def test_a_control_that_moves_the_target_through_other_bones_is_an_input(tmp_path, bounds):
    face()
    save_copy(tmp_path / "rig.blend")
    control = SLIDE if bounds[0] == -0.05 else f"{SLIDE}={bounds[0]}:{bounds[1]}"
    recording = recorded(tmp_path, "--learn-from", "flesh", "--poses", 20, *ARM, "--extra-input", control)
    assert list(recording.rig.joint_names) == ["upper", "lower"]
    partition = next(p for p in skin_recording(recording).partitions if recording.rig.joint_names[p.joint] == "lower")
    assert partition.controls == (0,)
    # It is one control with one range and is sampled once.
    (sampled,) = [channel for channel in recording.info.sampling.channels if "slider" in channel.name]
    assert (sampled.name, sampled.kind) == ("slider", "location")
    assert (sampled.low, sampled.high) == pytest.approx(bounds)
    values = np.array(recording.controls)[:, 0]
    assert bounds[0] <= values.min() and values.max() <= bounds[1] and np.ptp(values) > 0.02


def test_a_control_of_a_bone_that_is_a_joint_is_an_input(tmp_path):
    """The rotation of the elbow is a control in addition to its joint; both change together."""
    targets.target_copy()
    save_copy(tmp_path / "rig.blend")
    bend = 'armature_object/pose.bones["lower"].rotation_euler[0]'
    recording = recorded(tmp_path, "--learn-from", "flesh", "--poses", 20, "--extra-input", bend)
    assert [partition.controls for partition in skin_recording(recording).partitions] == [(0,), (0,)]
    assert np.ptp(recording.controls) > 0.5


SMILE = 'armature_object/["smile"]'


def keyed_smile() -> None:
    """The tube and its target, whose shape key follows a property of the armature that the action keys."""
    flesh = targets.target_copy()
    armature_object = bpy.data.objects["elbow_rig"]
    armature_object["smile"] = 0.0
    armature_object.id_properties_ui("smile").update(min=0.0, max=1.0)
    flesh.shape_key_add(name="Basis")
    key = flesh.shape_key_add(name="smile")
    for point in key.data[: len(key.data) // 2]:
        point.co.z += 0.05
    variable = key.driver_add("value").driver.variables.new()
    variable.name, variable.targets[0].id, variable.targets[0].data_path = "smile", armature_object, '["smile"]'
    key.id_data.animation_data.drivers[0].driver.expression = "smile"
    for frame, value in ((1, 0.0), (20, 1.0)):
        armature_object["smile"] = value
        armature_object.keyframe_insert('["smile"]', frame=frame)


def test_a_keyed_property_that_is_a_control_does_not_bind_the_target_to_frames(tmp_path, capsys):
    keyed_smile()
    save_copy(tmp_path / "rig.blend")
    action = bpy.data.objects["elbow_rig"].animation_data.action.name
    options = ("--object", "elbow", "--learn-from", "flesh", "--poses", 20)
    assert run("record", tmp_path / "rig.blend", tmp_path / "without", *options) == 1
    assert "follows frames (the keys of '[\"smile\"]' of 'elbow_rig')" in capsys.readouterr().err
    recording = recorded(tmp_path, "--learn-from", "flesh", "--poses", 20, "--extra-input", SMILE, "--action", action)
    assert recording.info.target.follows == "pose"
    assert np.ptp(np.array(recording.controls)[:20, 0]) > 0.5
    # Half of the vertices move by 50 mm with the property.
    skinned = skin_recording(recording)
    residuals = np.linalg.norm(skinned.compute_residuals(np.arange(len(skinned.rows))), axis=-1)
    assert np.abs(np.corrcoef(skinned.controls[:, 0], residuals.max(axis=1))[0, 1]) > 0.5
