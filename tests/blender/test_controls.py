# SPDX-License-Identifier: GPL-3.0-or-later
"""Extra inputs: numbers of every type, control bones, and controls that deform a target."""

import json
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import control_face, targets
from blend_fixtures.characters.base import add_key, drive
from blend_fixtures.characters.bones import NewBone, add_bones, limit, wave
from blend_fixtures.characters.controls import add_property
from blend_fixtures.characters.targets import TARGET
from fdda_addon.core.controls import Control
from fdda_addon.core.errors import RigError
from fdda_addon.core.mathematics.poses import LOCATION, ROTATION, ROTATION_VECTOR, Channel
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.core.recording.skinned import skin_recording
from fdda_addon.poses.action_range import curves_by_bone, keyed_numbers
from fdda_addon.poses.sample_selection import bones_without_location_range, describe_control_bones, rotation_elements
from fdda_addon.recording.plan import RecordingSettings, listed_controls, read_sampled_rig
from fdda_addon.rig.dependencies import read_dependencies
from fdda_addon.runtime import driver
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.compatibility import animation_curves
from fdda_addon.scene.control_reader import ControlReader
from fdda_addon.scene.controls import canonical_path, control_default, is_driven, parse_controls, set_control
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from .conftest import ELBOW_RIG, assert_plays, run, train


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
    path = path.replace("#", str(armature_object.pose.bones.find("aim")))
    drive(mesh_object.modifiers.new("Cast", "CAST"), "factor", armature_object, path)
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


FACE = f"collection:{control_face.COLLECTION}"

MAX_ERROR_RATIO = 0.15
"""Largest mean error with the controls, as a ratio of the mean error without them."""

EYE_ELEMENTS = [f'pose.bones["eye"].matrix_basis[{column}][{row}]' for column in (0, 1) for row in (0, 1, 2)]

PATHS = {
    'pose.bones["brow"].location[0]', 'pose.bones["brow"].location[2]', *EYE_ELEMENTS,
    'pose.bones["lid"].matrix_basis[2][2]', 'pose.bones["lid"].matrix_basis[2][0]',
    'pose.bones["mouth"].scale[2]', 'pose.bones["mouth"]["smile"]',
}  # fmt: skip


@pytest.fixture
def face() -> SceneRig:
    control_face.control_face()
    return find_rig("elbow")


@pytest.fixture(scope="module")
def face_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record and train the face with and without its control bones; return the folder of the files."""
    folder = tmp_path_factory.mktemp("control_face")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    control_face.control_face()
    save_copy(folder / "face.blend")
    control_face.add_speech()
    save_copy(folder / "speech.blend")
    bones = ("--bones-to-pose", FACE, "--bones-to-pose", "bone:lower", "--learn-from", TARGET)
    for name, options in (("with", ("--extra-input", FACE)), ("without", ())):
        recording = folder / f"{name}_recording"
        options = ("--object", "elbow", "--poses", 300, "--spread", 10, *bones, *options)
        assert run("record", folder / "face.blend", recording, *options) == 0
        train(recording, folder / f"{name}.onnx", "--passes", 80)
    return folder


def test_a_face_is_learned_only_with_its_control_bones(face_folder, tmp_path):
    means = {}
    for name in ("with", "without"):
        report = tmp_path / f"{name}.json"
        options = ("--object", "elbow", "--learn-from", TARGET, "--poses", 0, "--action", control_face.SPEECH)
        files = (face_folder / "speech.blend", face_folder / f"{name}.onnx", "--json", report)
        assert run("evaluate", *files, *options) == 0
        (errors,) = json.loads(report.read_text())["actions"]
        means[name], linear = errors["fdda"]["mean"], errors["linear"]["mean"]
    assert linear > 1 and means["with"] < MAX_ERROR_RATIO * means["without"]


def test_the_recording_has_the_controls_and_their_influences(face_folder):
    recording = read_recording(face_folder / "with_recording")
    assert {control.path for control in recording.rig.controls} == PATHS
    assert list(recording.rig.joint_names) == ["upper", "lower"]
    partition = next(p for p in skin_recording(recording).partitions if recording.rig.joint_names[p.joint] == "lower")
    assert set(partition.controls) == set(range(len(PATHS)))
    values = np.array(recording.controls)
    assert (np.ptp(values, axis=0) > 0.02).all()
    # The columns of a rotation have the length 1; the bone `lid` rotates about one axis.
    paths = [control.path for control in recording.rig.controls]
    for elements in (EYE_ELEMENTS[:3], EYE_ELEMENTS[3:], [path for path in paths if '"lid"' in path]):
        columns = values[:, [paths.index(path) for path in elements]]
        assert np.linalg.norm(columns, axis=1) == pytest.approx(1, abs=1e-5)


@pytest.fixture
def bound_face(face_folder, tmp_path) -> bpy.types.Object:
    """Bind the model with control bones, and return the mesh object."""
    path = tmp_path / "bound.blend"
    assert run("bind", face_folder / "speech.blend", face_folder / "with.onnx", path, "--object", "elbow") == 0
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return bpy.data.objects["elbow"]


def test_playback_follows_the_control_bones(bound_face, face_folder):
    """Every kind of channel is followed, keyed and set by hand; a full turn of a bone does not jump."""
    armature_object = bpy.data.objects[control_face.ARMATURE]
    bones, shapes = armature_object.pose.bones, []
    for frame in (1, 9, 20):
        bpy.context.scene.frame_set(frame)
        shapes.append(assert_plays(bound_face, face_folder / "with.onnx"))
    assert all(np.abs(shapes[n] - shapes[n - 1]).max() > 0.002 for n in range(3))
    armature_object.animation_data.action = None
    for bone, attribute, value in (
        ("brow", "location", (0.02, 0, 0.03)),
        ("eye", "rotation_quaternion", (0.9, 0.4, 0, 0)),
        ("lid", "rotation_euler", (0, 1, 0)),
        ("mouth", "scale", (1, 1, 1.5)),
    ):
        setattr(bones[bone], attribute, value)
        bpy.context.view_layer.update()
        shapes.append(assert_plays(bound_face, face_folder / "with.onnx"))
        assert np.abs(shapes[-1] - shapes[-2]).max() > 1e-4, bone
    bones["mouth"]["smile"] = 1.0
    armature_object.update_tag()
    bpy.context.view_layer.update()
    assert np.abs(assert_plays(bound_face, face_folder / "with.onnx") - shapes[-1]).max() > 1e-4
    before = assert_plays(bound_face, face_folder / "with.onnx")
    bones["eye"].rotation_quaternion = -np.array(bones["eye"].rotation_quaternion)
    bones["lid"].rotation_euler[1] += 2 * np.pi
    bpy.context.view_layer.update()
    assert np.abs(assert_plays(bound_face, face_folder / "with.onnx") - before).max() < 1e-5


@pytest.mark.parametrize("change", ["rename", "remove"])
def test_a_missing_control_bone_is_named(bound_face, change):
    armature_object = bpy.data.objects[control_face.ARMATURE]
    if change == "rename":
        armature_object.data.bones["eye"].name = "eye.L"
    else:
        bpy.context.view_layer.objects.active = armature_object
        bpy.ops.object.mode_set(mode="EDIT")
        armature_object.data.edit_bones.remove(armature_object.data.edit_bones["eye"])
        bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    bpy.context.scene.frame_set(3)
    assert "'elbow' lacks the control bone 'eye'; name it as before" in bound_face.fdda.status


def test_locked_and_driven_channels_are_left_out(face):
    bones = face.armature_object.pose.bones
    settings = RecordingSettings(extra_inputs=(FACE,))
    assert {control.path for control in listed_controls(face, settings)} == PATHS
    bones["brow"].lock_location[0] = True
    bones["mouth"].driver_add("scale", 2)
    bones["lid"].driver_add("rotation_euler", 1)
    paths = {control.path for control in listed_controls(face, settings)}
    assert paths == PATHS - {path for path in PATHS if "location[0]" in path or "lid" in path or "scale" in path}
    with pytest.raises(RigError, match="No channel of the 1 control bones of 'elbow_rig', such as 'still', may move"):
        listed_controls(face, RecordingSettings(extra_inputs=("bone:still",)))
    with pytest.raises(RigError, match="'elbow_rig' has no bone collection 'Mouth'; its collections: 'Face'"):
        listed_controls(face, RecordingSettings(extra_inputs=("collection:Mouth",)))
    with pytest.raises(RigError, match="has no bone collection 'Face=0:1'"):
        listed_controls(face, RecordingSettings(extra_inputs=(f"{FACE}=0:1",)))


def test_control_bones_are_posed_besides_the_default_bones(face):
    """Their locations without limits take the ranges of recorded actions; without any they are reported."""
    rig, channels = read_sampled_rig(face, RecordingSettings(extra_inputs=("bone:brow",)))
    assert {channel.name for channel in channels} == {"upper", "lower", "brow", "lid", "mouth"}
    assert set(rig.joint_names) == {"upper", "lower"}, "bones that are posed and have no weights are no joints"
    brow = face.armature_object.pose.bones["brow"]
    brow.constraints.remove(brow.constraints[0])
    brow.lock_rotation[0] = False
    controls = listed_controls(face, RecordingSettings(extra_inputs=("bone:brow",)))
    assert len(controls) == 2 and bones_without_location_range(face.armature_object, ["brow"], controls) == ["brow"]
    control_face.add_speech()
    settings = RecordingSettings(extra_inputs=("bone:brow",), actions=(control_face.SPEECH,))
    controls = listed_controls(face, settings)
    assert {control.path[-11:] for control in controls if "location" in control.path} == {"location[0]", "location[2]"}
    assert bones_without_location_range(face.armature_object, ["brow"], controls) == []


@pytest.mark.parametrize(
    ("channels", "elements"),
    [
        ([], []),
        ([(LOCATION, 0)], []),
        ([(ROTATION, 0)], [(1, 1), (1, 2)]),
        ([(ROTATION, 1)], [(2, 2), (2, 0)]),
        ([(ROTATION, 2)], [(0, 0), (0, 1)]),
        ([(ROTATION, 0), (ROTATION, 2)], [(c, r) for c in (0, 1) for r in (0, 1, 2)]),
        ([(ROTATION_VECTOR, 0)], [(c, r) for c in (0, 1) for r in (0, 1, 2)]),
    ],
)
def test_a_rotation_becomes_two_columns_or_cosine_and_sine(channels, elements):
    assert rotation_elements([Channel("bone", kind, axis, -1.0, 1.0) for kind, axis in channels]) == elements


def test_constraints_of_control_bones_are_read_unless_drivers_read_the_channels(face):
    bones, controls = face.armature_object.pose.bones, listed_controls(face, RecordingSettings(extra_inputs=(FACE,)))
    bones["brow"].location = (0.5, 0, 0)
    bones["lid"].rotation_euler[1], bones["mouth"].scale[2] = 2.0, 3.0
    bones["still"].rotation_euler = (0.3, 0.6, 0)
    copy = bones["eye"].constraints.new("COPY_ROTATION")
    copy.target, copy.subtarget, copy.owner_space, copy.target_space = face.armature_object, "still", "LOCAL", "LOCAL"
    limit(bones["eye"], "LIMIT_SCALE", {0: (0.5, 0.8)})
    controls += parse_controls(face, ['armature_object/pose.bones["eye"].scale[0]=0:1'])
    reader = ControlReader(face, controls)
    bpy.context.view_layer.update()
    read = reader.read(face, bpy.context.evaluated_depsgraph_get())
    values = {control.path.removeprefix("pose.bones"): value for control, value in zip(controls, read, strict=True)}
    # A bone follows the brow, so it stays at the limit; drivers read the channels of the lid and the mouth.
    assert values['["brow"].location[0]'] == pytest.approx(0.02)
    assert values['["lid"].matrix_basis[2][2]'] == pytest.approx(np.cos(2), abs=1e-6)
    assert values['["mouth"].scale[2]'] == pytest.approx(3)
    assert values['["eye"].scale[0]'] == pytest.approx(0.8)
    expected = np.array(bones["still"].matrix_basis)[:3, 1]
    assert [values[f'["eye"].matrix_basis[1][{row}]'] for row in range(3)] == pytest.approx(expected, abs=1e-5)
    assert not reader.warning


def test_a_constraint_along_an_axis_that_is_no_input_warns(bound_face):
    """The brow has inputs along x and z."""
    armature_object = bpy.data.objects[control_face.ARMATURE]
    armature_object.animation_data.action = None
    lift = armature_object.pose.bones["brow"].constraints.new("LIMIT_LOCATION")
    lift.use_min_z, lift.min_z = True, 0.1
    bpy.context.view_layer.update()
    assert bound_face.fdda.mode == "FDDA" and "moves the control bone 'brow' along an axis" in bound_face.fdda.status
    lift.mute = True
    bpy.context.view_layer.update()
    assert bound_face.fdda.mode == "FDDA" and not bound_face.fdda.status


def test_sixty_control_bones_are_read_through_sixty_dependencies():
    control_face.many_control_bones()
    rig = find_rig("elbow")
    controls = listed_controls(rig, RecordingSettings(extra_inputs=(FACE,)))
    reader = ControlReader(rig, controls)
    assert len(controls) == 60 * 9 and len(reader.sources) == 60
    assert len(driver.pose_inputs(rig, reader.sources)) == 61
    names = [bone.name for bone in rig.armature_object.pose.bones if bone.name.startswith("control")]
    for index, name in enumerate(names):
        rig.armature_object.pose.bones[name].location[1] = index / 1000
    bpy.context.view_layer.update()
    values = reader.read(rig, bpy.context.evaluated_depsgraph_get())
    locations = [value for control, value in zip(controls, values, strict=True) if control.path.endswith("location[1]")]
    assert locations == pytest.approx(np.arange(60) / 1000)


def test_custom_properties_without_a_range_are_named(face, capfd):
    """They are no inputs; the verb and the sidebar say which, unless the user gives a range."""
    armature_object = face.armature_object
    mouth = armature_object.pose.bones["mouth"]
    mouth['pu"ff'], mouth["strap"] = 0.5, 0.5
    expected = (
        """The custom property 'pu"ff' of 'mouth' and 1 more has no range and is no input; set Soft Min and Soft Max """
        "in the settings of the property."
    )
    controls = listed_controls(face, RecordingSettings(extra_inputs=("bone:mouth",)))
    sentence = describe_control_bones(armature_object, ["mouth"], controls)
    assert sentence == f"1 control bone with 2 inputs. {expected}"

    for bone in armature_object.pose.bones:
        owner = bone if hasattr(bone, "select") else bone.bone
        owner.select = bone == mouth
    assert bpy.ops.fdda.add_control_bones(object="elbow") == {"FINISHED"}
    assert f"Info: Added {sentence}" in capfd.readouterr().out
    mouth.id_properties_ui("strap").update(soft_min=0.0, soft_max=1.0)
    listed = ("bone:mouth", """armature_object/pose.bones["mouth"]["pu\\"ff"]=0:1""")
    controls = listed_controls(face, RecordingSettings(extra_inputs=listed))
    assert describe_control_bones(armature_object, ["mouth"], controls) == "1 control bone with 4 inputs."


def test_locations_without_a_range_are_named_unless_an_axis_has_one(face):
    """The axes that no limit and no action moves are seldom those that deform the mesh."""
    armature_object = face.armature_object
    mouth = armature_object.pose.bones["mouth"]
    mouth.lock_location = (False, False, True)
    controls = (Control("armature_object", 'pose.bones["mouth"].location[0]', 0.0, 1.0),)
    assert "location" not in describe_control_bones(armature_object, ["mouth"], controls)
    assert (
        "The location of 'mouth' has no range, so random poses do not move it; lock it, give it a Limit Location, or "
        "record an action that moves it."
    ) in describe_control_bones(armature_object, ["mouth"], ())


def test_control_bones_with_brackets_in_their_names_are_counted_one_by_one(face):
    bones = face.armature_object.pose.bones
    bones["eye"].name, bones["lid"].name = "upper]eye", "upper]lid"
    controls = listed_controls(face, RecordingSettings(extra_inputs=("bone:upper]eye", "bone:upper]lid")))
    sentence = describe_control_bones(face.armature_object, ["upper]eye", "upper]lid"], controls)
    assert sentence.startswith("2 control bones with 8 inputs.")


SLIDE = 'armature_object/pose.bones["slider"].location[0]'

ARM = ("--bones-to-pose", "bone:lower", "--bones-to-pose", "bone:slider")


def add_slider() -> None:
    """The tube and its target `flesh`, which alone follows the bone `cheek`. That bone follows `slider`."""
    flesh = targets.target_copy()
    armature_object = bpy.data.objects["elbow_rig"]
    add_bones(
        armature_object,
        NewBone("slider", (0.8, 0, 0), (0.8, 0, 0.1), is_deforming=False),
        NewBone("cheek", (0.35, 0, 0), (0.35, 0, 0.1), "lower"),
    )
    near = [vertex.index for vertex in flesh.data.vertices if vertex.co.x > 0.3]
    flesh.vertex_groups.new(name="cheek").add(near, 0.5, "REPLACE")
    follow = armature_object.pose.bones["cheek"].constraints.new("COPY_LOCATION")
    follow.target, follow.subtarget, follow.use_offset = armature_object, "slider", True
    follow.owner_space = follow.target_space = "LOCAL"
    limit(armature_object.pose.bones["slider"], "LIMIT_LOCATION", {0: (-0.05, 0.05)})


def recorded(tmp_path: Path, *options: object) -> Recording:
    assert run("record", tmp_path / "rig.blend", tmp_path / "recording", "--object", "elbow", *options) == 0
    return read_recording(tmp_path / "recording")


@pytest.mark.parametrize("bounds", [(-0.05, 0.05), (-0.02, 0.04)])
def test_a_control_that_moves_the_target_through_other_bones_is_an_input(tmp_path, bounds):
    add_slider()
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
    add_property(armature_object, "smile")
    key = add_key(
        flesh, "smile", lambda points: points + [(0, 0, 0.05 * (n < len(points) // 2)) for n in range(len(points))]
    )
    drive(key, "value", armature_object, '["smile"]')
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
