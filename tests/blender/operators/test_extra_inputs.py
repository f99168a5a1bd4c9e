# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators that add and remove extra inputs, and the ranges of extra inputs."""

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import controls
from fdda_addon.core.mathematics.poses import CONTROL
from fdda_addon.core.recording.index import read_index
from fdda_addon.panels import checks
from fdda_addon.panels.sampling import describe_channels
from fdda_addon.properties.character import recording_folder
from fdda_addon.properties.recording_options import recording_settings
from fdda_addon.recording.plan import read_sampled_rig
from fdda_addon.scene.control_names import control_default, suggested_controls

from ..arm_and_face import IK, recorded, saved


def test_shape_keys_are_recorded_in_the_given_or_default_range(face):
    assert bpy.ops.fdda.add_control(name="flexed") == {"FINISHED"}
    assert bpy.ops.fdda.add_control(name="thin") == {"FINISHED"}
    control = face.mesh_object.fdda.settings.extra_inputs["flexed"]
    control.has_range, control.low, control.high = True, 0.25, 0.75
    check = checks.check_now(face)
    assert check.problems == () and check.automatic_controls == ()
    assert describe_channels(check).endswith(" channels) and 2 extra inputs.")
    recording = recorded(face)
    ranges = {control.path: (control.low, control.high) for control in recording.rig.controls}
    assert ranges == {'key_blocks["flexed"].value': (0.25, 0.75), 'key_blocks["thin"].value': (-0.5, 1.0)}
    assert recording.controls[:, 0].min() >= 0.25 and recording.controls[:, 0].max() <= 0.75
    assert np.ptp(recording.controls[:, 0]) > 0.1


def test_shape_keys_are_inputs_without_being_added(face):
    keys = face.mesh_object.data.shape_keys
    for name in ("muted", "moves nothing"):
        face.mesh_object.shape_key_add(name=name, from_mix=False)
    keys.key_blocks["muted"].mute, keys.key_blocks["muted"].data[0].co.x = True, 1.0
    recorded(face)
    index = read_index(recording_folder(face.mesh_object))
    assert [control["path"] for control in index["controls"]] == [
        'key_blocks["flexed"].value',
        'key_blocks["thin"].value',
    ]


def test_an_unknown_control_is_a_problem_and_an_unnamed_one_is_not(face):
    with pytest.raises(RuntimeError, match="'elbow' has no control 'smile/'; give the name of a shape key"):
        bpy.ops.fdda.add_control(name="smile")
    settings = face.mesh_object.fdda.settings
    assert bpy.ops.fdda.add_control() == {"FINISHED"}
    assert checks.check_now(face).problems == (), "it is being filled in"
    settings.extra_inputs[0].name = "smile"
    assert checks.check_now(face).problems[0].startswith("'elbow' has no control 'smile/'")
    assert bpy.ops.fdda.remove_control() == {"FINISHED"}
    assert not settings.extra_inputs and checks.check_now(face).problems == ()
    with pytest.raises(RuntimeError, match="No extra input is active; click one in the list"):
        bpy.ops.fdda.remove_control()


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ('objects["elbow"].data.shape_keys.key_blocks["flexed"].value', "flexed"),
        ('shape_keys["KEYS"].key_blocks["thin"].value', "thin"),
        ('objects["elbow_rig"].pose.bones["upper"].location[1]', 'armature_object/pose.bones["upper"].location[1]'),
        ('armatures["elbow_rig"].display_type', None),
        ('objects["elbow"].data.shape_keys.key_blocks["gone"].value', None),
        ("objects", None),
    ],
)
def test_a_full_data_path_is_shortened(face, path, name):
    keys, armature = face.mesh_object.data.shape_keys, face.armature_object.data
    path = "bpy.data." + path.replace("KEYS", keys.name).replace(
        'armatures["elbow_rig"]', f'armatures["{armature.name}"]'
    )
    control = face.mesh_object.fdda.settings.extra_inputs.add()
    control.name = path
    assert control.name == (name or path)


def test_a_full_data_path_is_added_by_its_short_name(face):
    path = 'bpy.data.objects["elbow"].data.shape_keys.key_blocks["flexed"].value'
    assert bpy.ops.fdda.add_control(name=path) == {"FINISHED"}
    assert [control.name for control in face.mesh_object.fdda.settings.extra_inputs] == ["flexed"]
    with pytest.raises(RuntimeError, match="'flexed' is already in the list"):
        bpy.ops.fdda.add_control(name=path)


def test_an_empty_range_is_a_problem(face):
    bpy.ops.fdda.add_control(name="thin")
    control = face.mesh_object.fdda.settings.extra_inputs[0]
    control.has_range, control.low, control.high = True, 1.0, 0.5
    (problem,) = checks.check_now(face).problems
    assert problem.startswith("The control 'shape_keys/key_blocks[\"thin\"].value' has no range; give one")


def test_controls_that_drivers_read_are_detected(tmp_path):
    controls.custom_property()
    rig = saved(tmp_path)
    check = checks.check_now(rig)
    # The property acts through the key alone, so random poses set the key without its driver.
    assert [control.name for control in check.automatic_controls] == ['shape_keys/key_blocks["flexed"].value']
    _, channels = read_sampled_rig(rig, recording_settings(rig))
    assert channels == check.channels
    assert [channel.name for channel in channels if channel.kind == CONTROL] == [
        'shape_keys/key_blocks["flexed"].value'
    ]


def test_properties_are_suggested(arm):
    arm.armature_object.pose.bones["fk_upper"]["follow"] = 1.0
    names = suggested_controls(arm)
    assert names == [IK, 'armature_object/pose.bones["fk_upper"]["follow"]', "collection:Controls"]


def test_the_default_values_of_controls_are_read(arm):
    arm.armature_object.id_properties_ui("ik").update(default=0.25)
    arm.armature_object["on"] = True
    arm.armature_object.pose.bones["fk_upper"]["follow"] = 3
    bone = 'armature_object/pose.bones["fk_upper"]'
    assert control_default(arm, IK) == 0.25
    assert control_default(arm, 'armature_object/["on"]') == 0
    assert control_default(arm, f"{bone}.scale[1]") == 1 and control_default(arm, f"{bone}.location[1]") == 0
    assert control_default(arm, f'{bone}["follow"]') == 0
