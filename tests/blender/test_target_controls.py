# SPDX-License-Identifier: GPL-3.0-or-later
"""Controls that deform a target, or that are channels of sampled bones, are inputs if they move the surface."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import targets
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.scene.blend_file import save_copy

from .conftest import run

SLIDE = 'armature_object/pose.bones["slider"].location[0]'
ARM = ("--sample", "bone:lower", "--sample", "bone:slider")


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
    bpy.ops.wm.read_factory_settings(use_empty=True)
    face()
    save_copy(tmp_path / "rig.blend")
    control = SLIDE if bounds[0] == -0.05 else f"{SLIDE}={bounds[0]}:{bounds[1]}"
    recording = recorded(tmp_path, "--target", "flesh", "--poses", 20, *ARM, "--control", control)
    assert list(recording.rig.joint_names) == ["upper", "lower"]
    partition = next(p for p in recording.partitions if recording.rig.joint_names[p.joint] == "lower")
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
    recording = recorded(tmp_path, "--target", "flesh", "--poses", 20, "--control", bend)
    assert [partition.controls for partition in recording.partitions] == [(0,), (0,)]
    assert np.ptp(recording.controls) > 0.5
