# SPDX-License-Identifier: GPL-3.0-or-later
"""Controls: properties of every type are read and set by their RNA paths."""

import bpy
import pytest

from blend_fixtures.characters.bones import NewBone, add_bones
from fdda_addon.core.errors import RigError
from fdda_addon.poses.action_range import curves_by_bone, keyed_numbers
from fdda_addon.rig.dependencies import read_dependencies
from fdda_addon.scene.compatibility import animation_curves
from fdda_addon.scene.control_names import control_default
from fdda_addon.scene.control_reader import ControlReader
from fdda_addon.scene.controls import canonical_path, is_driven, parse_controls, set_control

from .conftest import ELBOW_RIG
from .waves import wave


@pytest.fixture
def armature_object(rig) -> bpy.types.Object:
    """Return the elbow's armature object with custom properties of every type."""
    armature_object = bpy.data.objects[ELBOW_RIG]
    armature_object["dial"], armature_object["count"] = 0.5, 3
    armature_object["is_on"], armature_object["odd [name]"] = True, 0.1
    armature_object["many"] = [0.1, 0.2, 0.3]
    for name in ("dial", "count", "odd [name]", "many"):
        armature_object.id_properties_ui(name).update(min=-2, max=4, soft_min=-1, soft_max=2)
    armature_object.pose.bones["lower"]["fist"] = 0.25
    armature_object.pose.bones["lower"].id_properties_ui("fist").update(min=0, max=1)
    bpy.context.view_layer.update()
    return armature_object


@pytest.mark.parametrize(
    ("path", "limits", "value"),
    [
        ('["dial"]', (-1, 2), 1.5),
        ('["count"]', (-1, 2), 2),
        ('["is_on"]', (0, 1), False),
        ('["odd [name]"]', (-1, 2), -0.5),
        ('["many"][1]', (-1, 2), 0.75),
        ('pose.bones["lower"]["fist"]', (0, 1), 0.5),
        ('pose.bones["lower"].bbone_curveinx', None, 0.125),
        ("location[2]", None, 0.25),
    ],
)
def test_a_control_is_read_and_set(rig, armature_object, path, limits, value):
    text = f"armature_object/{path}" + ("" if limits else "=-1:1")
    (control,) = parse_controls(rig, [text])
    assert (control.low, control.high) == (limits or (-1, 1)) and not is_driven(armature_object, path)
    reader = ControlReader(rig, (control,))
    set_control(rig, control.name, value)
    assert type(armature_object.path_resolve(path)) is type(value) or not isinstance(value, bool | int)
    assert reader.read(rig, bpy.context.evaluated_depsgraph_get()).tolist() == [value]
    assert isinstance(control_default(rig, control.name), float)


def test_only_the_named_element_is_set(rig, armature_object):
    set_control(rig, 'armature_object/["many"][1]', 0.75)
    assert list(armature_object["many"]) == pytest.approx([0.1, 0.75, 0.3])


@pytest.mark.parametrize("name", ['armature_object/["none"]', 'armature_object/["many"]', "elsewhere/location[0]", "x"])
def test_a_path_without_a_number_is_refused(rig, armature_object, name):
    with pytest.raises(RigError, match=r"'elbow' has no control '.*'; give the name of a shape key, or OWNER/PATH"):
        parse_controls(rig, [name])


def test_a_number_without_a_range_is_refused(rig, armature_object):
    with pytest.raises(RigError, match=r"has no range; give one: 'armature_object/location\[0\]=LOW:HIGH'"):
        parse_controls(rig, ["armature_object/location[0]"])


@pytest.mark.parametrize(
    ("path", "bone", "control"),
    [
        ("pose.bones[#].rotation_euler[0]", "aim", ""),
        ('pose.bones["aim"].rotation_euler.x', "aim", ""),
        ("pose.bones[ # ].location.z", "aim", ""),
        ('pose.bones[#]["bend [3].x"]', "", 'pose.bones["aim"]["bend [3].x"]'),
        ("pose.bones[#].constraints[0].influence", "", 'pose.bones["aim"].constraints["fix"].influence'),
    ],
)
def test_a_driver_reads_the_same_by_numbers_as_by_names(rig, path, bone, control):
    """A driver gives elements of its path by numbers, or an axis by its letter."""
    armature_object, mesh_object = rig.armature_object, rig.mesh_object
    add_bones(armature_object, NewBone("aim", (0.0, 0.0, 0.3), (0.1, 0.0, 0.3), is_deforming=False))
    aim = armature_object.pose.bones["aim"]
    aim.constraints.new("LIMIT_SCALE").name = "fix"
    aim["bend [3].x"] = 0.5
    aim.id_properties_ui("bend [3].x").update(min=0, max=1)
    driver = mesh_object.modifiers.new("Cast", "CAST").driver_add("factor").driver
    target = driver.variables.new().targets[0]
    driver.type = "SUM"
    target.id, target.data_path = armature_object, path.replace("#", str(armature_object.pose.bones.find("aim")))
    dependencies = read_dependencies(rig)
    assert dependencies.bones == ({bone} if bone else set())
    assert [c.path for c in dependencies.controls] == ([control] if control else [])


def test_keys_and_drivers_are_found_by_numbers_as_by_names(rig, armature_object):
    index = armature_object.pose.bones.find("lower")
    action = wave(armature_object, "lower")
    armature_object.animation_data.action = action
    armature_object.pose.bones["lower"].keyframe_insert('["fist"]', frame=1)
    armature_object.pose.bones["lower"].driver_add("scale", 1)
    for curve in (*animation_curves(action), *armature_object.animation_data.drivers):
        curve.data_path = curve.data_path.replace('["lower"]', f"[{index}]")
    path = 'pose.bones["lower"]'
    assert curves_by_bone(armature_object, {armature_object: animation_curves(action)})["lower"][
        "rotation_euler"
    ].keys() == {0, 1, 2}
    assert ("armature_object", f'{path}["fist"]') in keyed_numbers(rig, [action])[0]
    assert is_driven(armature_object, f"{path}.scale[1]") and not is_driven(armature_object, f"{path}.scale[0]")
    (control,) = parse_controls(rig, [f'armature_object/pose.bones[{index}]["fist"]'])
    assert control.path == f'{path}["fist"]'


@pytest.mark.parametrize(
    "path", ['["many"][1]', "matrix_world[0][3]", "pose.bones[99].location[0]", "none[0].x", "location[2]", "name.x"]
)
def test_paths_without_named_elements_do_not_change(armature_object, path):
    assert canonical_path(armature_object, path) == path
