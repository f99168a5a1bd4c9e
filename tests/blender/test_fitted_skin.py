# SPDX-License-Identifier: GPL-3.0-or-later
"""Models with fitted skin weights, of all bones or of key joints: training, playback, fast rigs, the sidebar."""

import dataclasses
import json
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import stacks
from blend_fixtures.characters.base import drive
from blend_fixtures.characters.bones import NewBone, add_bones, add_delta_mush, add_smooth_weights, limb, limit, wave
from blend_fixtures.elbow import END, START, build_elbow, lower_weights
from fdda_addon.core.controls import Control
from fdda_addon.core.errors import ModelError
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.formats.model_info import ModelInfo
from fdda_addon.core.mathematics.key_joints import find_unread_bones
from fdda_addon.core.mathematics.skin_fit import SkinFit
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.folder import FolderState, read_folder
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.rig import Rig
from fdda_addon.evaluation import heat_map
from fdda_addon.evaluation.run import evaluate
from fdda_addon.evaluation.settings import EvaluationSettings
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import MISSING_WEIGHTS, record
from fdda_addon.rig.deformation import describe_bones, read_unread_bones
from fdda_addon.rig.reading import PoseReader, read_rig
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.runtime.network import Network
from fdda_addon.runtime.session import session
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.mesh import rest_positions
from fdda_addon.scene.scene_rig import SceneRig, find_rig, join_rigs

from .conftest import ELBOW, Trained, assert_plays, build_and_train, evaluated_positions, pose, run, train
from .rig_changes import change_in_edit_mode, trigger_check
from .scene_state import drain
from .stand_ins import import_from


def build_rigid_elbow() -> None:
    """Build an elbow with one bone per vertex, smoothed by Corrective Smooth (delta mush)."""
    mesh_object, _ = build_elbow()
    lower = lower_weights(np.array([vertex.co for vertex in mesh_object.data.vertices])) >= 0.5
    for name, is_member in (("upper", ~lower), ("lower", lower)):
        mesh_object.vertex_groups[name].remove(range(len(is_member)))
        mesh_object.vertex_groups[name].add(np.flatnonzero(is_member).tolist(), 1.0, "REPLACE")


def build_cloth() -> SceneRig:
    """Build a mesh without weights that a Surface Deform modifier attaches to a skinned body."""
    stacks.surface_deform()
    rig = find_rig(ELBOW)
    rig.mesh_object.modifiers.remove(rig.mesh_object.modifiers["Armature"])
    rig.mesh_object.vertex_groups.clear()
    return rig


@pytest.fixture(scope="module")
def make_fitted_character(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable], Trained]:
    """Return a function that records a character and trains a model with fitted weights, once for each kind."""

    @cache
    def make(kind: str, build: Callable[[], object]) -> Trained:
        options, training = ("--object", ELBOW, "--poses", 120), ("--passes", 25, "--base-skinning", kind)
        return build_and_train(tmp_path_factory.mktemp("fitted"), build, *options, training=training)

    return make


KINDS_AND_BUILDERS = [("hard", build_cloth), ("smooth", build_rigid_elbow)]


def pose_matrices(rig: SceneRig, recorded: Rig) -> np.ndarray:
    """Return the evaluated pose matrices (J, 4, 4) of the joints of a recording."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    reader = PoseReader(rig, recorded.joint_names, recorded.rest_matrices)
    return reader.read(*(o.evaluated_get(depsgraph) for o in (rig.mesh_object, rig.armature_object)))


@pytest.mark.parametrize(("kind", "build"), KINDS_AND_BUILDERS)
def test_fitted_weights_reduce_errors_and_are_in_the_model(kind, build, make_fitted_character):
    files = make_fitted_character(kind, build)
    recording, info = read_recording(files.recording), read_model_info(files.model)
    fit = SkinFit.from_json(info.training["fit"])
    assert fit.sentence() == info.skin_sentence and (fit.kind, fit.poses) == (kind, 120)
    for gain in (fit.held_out, fit.training):
        assert gain.rms_mm["fitted"] < 0.8 * gain.rms_mm["rig"]

    rig = files.open(ELBOW)
    rig_data = read_rig(rig)
    # The fingerprint describes the rig, and does not include fitted weights.
    assert recording.rig.meshes[0].fingerprint == rig_data.meshes[0].fingerprint == info.meshes[0].fingerprint
    assert [rig_data.joint_names[p.joint] for p in info.partitions] == ["upper", "lower"]
    linear_rig = Network(files.model).linear_rig(rig_data)
    assert (linear_rig.skin_weights > 0).sum(axis=1).max() == (1 if kind == "hard" else 2)
    assert (rig_data.skin_weights > 0).sum(axis=1).max() == 1

    evaluation = drain(evaluate(rig, files.model, EvaluationSettings(30)))
    assert evaluation.fdda.rms < 0.5 * evaluation.linear.rms
    # The evaluation uses other poses than the fit.
    assert evaluation.linear.rms == pytest.approx(fit.held_out.rms_mm["fitted"], rel=0.3)
    assert [p.joint for p in evaluation.partitions] == [p.joint for p in info.partitions]
    assert [len(p.vertices) for p in evaluation.partitions] == [p.vertices for p in info.partitions]


@pytest.mark.parametrize(("kind", "build"), KINDS_AND_BUILDERS)
def test_playback_uses_the_fitted_weights(kind, build, make_fitted_character):
    files = make_fitted_character(kind, build)
    rig = files.open(ELBOW)
    pose(angle=1.2)
    rig_shape = evaluated_positions(rig.mesh_object)
    bind(rig, files.model)
    model_positions = assert_plays(rig.mesh_object, files.model)
    heat_map.paint_partitions(rig)
    assert len(np.unique(heat_map.colors_of(rig.mesh_object), axis=0)) == 2
    rig.mesh_object.fdda.mode = "LINEAR"
    linear_positions = evaluated_positions(rig.mesh_object)
    linear_rig = Network(files.model).linear_rig(read_recording(files.recording).rig)
    matrices = pose_matrices(rig, linear_rig)
    np.testing.assert_allclose(linear_positions, LinearSkinning(linear_rig).positions(matrices[None])[0], atol=1e-5)
    errors = [np.linalg.norm(positions - rig_shape, axis=1).mean() for positions in (model_positions, linear_positions)]
    assert errors[0] < errors[1] < 0.01


def test_a_mesh_without_weights_is_recorded_and_needs_fitted_ones(refusal, tmp_path, capfd):
    rig = build_cloth()
    save_copy(tmp_path / "cloth.blend")
    rig.mesh_object.modifiers.new("Armature", "ARMATURE").object = rig.armature_object
    save_copy(tmp_path / "without_weights.blend")
    for name in ("cloth", "without_weights"):
        assert run("record", tmp_path / f"{name}.blend", tmp_path / name, "--object", ELBOW, "--poses", 12) == 0
        assert MISSING_WEIGHTS.format(ELBOW) in capfd.readouterr().out
        text = refusal("train", tmp_path / name, tmp_path / "m.onnx")
        assert text.startswith("The vertices of 'elbow' follow no bone by skin weights") and "--base-skinning" in text
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "cloth.blend"))
    settings = bpy.data.objects[ELBOW].fdda.settings
    settings.recording = str(tmp_path / "other")
    with pytest.raises(RuntimeError, match="have no weights on deforming bones of 'elbow_rig', so there is no linear"):
        bpy.ops.fdda.build_model(object=ELBOW)
    assert not (tmp_path / "other").exists()


def test_the_times_of_a_mesh_without_armature_modifier_lack_linear_skinning(make_fitted_character, capfd, tmp_path):
    files = make_fitted_character(*KINDS_AND_BUILDERS[0])
    times = tmp_path / "times.json"
    assert run("benchmark", files.rig, files.model, "--object", ELBOW, "--json", times, "--frames", 2) == 0
    assert "linear" not in json.loads(times.read_text())
    printed = capfd.readouterr().out
    assert "Armature modifier alone" not in printed and "FDDA" in printed


def test_a_python_without_scipy_is_named(refusal, elbow_files, tmp_path, monkeypatch):
    packages = tmp_path / "packages"
    packages.mkdir()
    (packages / "sitecustomize.py").write_text("import sys\nsys.modules['scipy'] = None\n")
    import_from(packages, monkeypatch)
    text = refusal("train", elbow_files.recording, tmp_path / "m.onnx", "--base-skinning", "smooth")
    assert "'scipy'" in text


MAIN_BONES = ("bone.0", "bone.1", "bone.2")

HELPERS = ("half.1", "half.2", "push.1", "push.2")
"""Bones of `limb_with_helpers` that follow the main bones by a constraint or a driver."""


def limb_with_helpers() -> tuple[bpy.types.Object, bpy.types.Object]:
    """Build a limb with delta mush of three main bones; each joint has a half-rotating bone and a driven bone."""
    mesh_object, armature_object = limb(len(MAIN_BONES), 15.0, twist=20.0)
    ends = np.linspace(START, END, len(MAIN_BONES) + 1).tolist()
    for number in (1, 2):
        x_position, parent = ends[number], f"bone.{number - 1}"
        add_bones(
            armature_object,
            NewBone(f"half.{number}", (x_position, 0.0, 0.0), (x_position + 0.04, 0.0, 0.0), parent),
            NewBone(f"push.{number}", (x_position - 0.04, 0.0, 0.0), (x_position, 0.0, 0.0), parent),
        )
        copy = armature_object.pose.bones[f"half.{number}"].constraints.new("COPY_ROTATION")
        copy.target, copy.subtarget, copy.influence = armature_object, f"bone.{number}", 0.5
        copy.target_space = copy.owner_space = "LOCAL"
        bend = f'pose.bones["bone.{number}"].rotation_euler[0]'
        drive(armature_object, f'pose.bones["push.{number}"].location', armature_object, bend, "0.03 * value", index=2)
    add_smooth_weights(mesh_object, armature_object, 4, 0.05)
    add_delta_mush(mesh_object, 2)
    return mesh_object, armature_object


@pytest.fixture(scope="module")
def limb_files(tmp_path_factory) -> Trained:
    training = ("--passes", 60, "--bones-to-read", "auto")
    return build_and_train(tmp_path_factory.mktemp("limb"), limb_with_helpers, "--poses", 300, training=training)


def build_limb() -> SceneRig:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return SceneRig(*limb_with_helpers())


def trained(rig: SceneRig, folder: Path) -> ModelInfo:
    """Record a rig and train a model with key joints; return the metadata of the model."""
    drain(record(rig, folder / "recording", RecordingSettings(poses=80, influence_poses=2)))
    train(folder / "recording", folder / "model.onnx", "--passes", 1, "--bones-to-read", "auto")
    return read_model_info(folder / "model.onnx")


def pose_limb(armature_object: bpy.types.Object) -> None:
    for number, name in enumerate(MAIN_BONES):
        armature_object.pose.bones[name].rotation_euler = (0.4, 0.5 - 0.3 * number, -0.2)
    bpy.context.view_layer.update()


def test_bones_that_follow_others_are_not_read(limb_files):
    recording, info = read_recording(limb_files.recording), read_model_info(limb_files.model)
    assert info.joint_names == MAIN_BONES
    report = SkinFit.from_json(info.training["fit"]).key_joints
    assert (report.joints, report.rig_joints, report.independent, report.still) == (3, 7, (), ())
    assert info.skin_sentence.startswith("Key joints: the model reads 3 of 7 joints; in random poses the ")
    rig = read_rig(limb_files.open())
    assert set(rig.joint_names) == set(recording.rig.joint_names) == {*MAIN_BONES, *HELPERS}
    assert recording.rig.meshes[0].fingerprint == rig.meshes[0].fingerprint
    assert info.meshes[0].fingerprint.skin_weights != rig.meshes[0].fingerprint.skin_weights
    assert set(info.meshes[0].fingerprint.deformation["unread_bones"]) == set(HELPERS)


def test_the_rest_is_learnt(limb_files):
    evaluation = drain(evaluate(limb_files.open(), limb_files.model, EvaluationSettings(40)))
    assert evaluation.linear.mean > 0.001
    assert evaluation.fdda.mean < 0.15 * evaluation.linear.mean


def test_the_model_plays_on_the_rig_and_a_saved_file_keeps_it(limb_files, tmp_path):
    rig = limb_files.open()
    bind(rig, limb_files.model)
    pose_limb(rig.armature_object)
    shown = assert_plays(rig.mesh_object, limb_files.model)
    rig.mesh_object.fdda.mode = "LINEAR"
    assert np.abs(evaluated_positions(rig.mesh_object) - shown).max() > 1e-4
    rig.mesh_object.fdda.mode = "FDDA"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "bound.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "bound.blend"))
    np.testing.assert_array_equal(assert_plays(bpy.data.objects["limb"], limb_files.model), shown)


@pytest.mark.parametrize("is_renamed", [False, True], ids=["other weights", "another bone"])
def test_changed_weights_of_a_bone_that_is_not_read_are_noticed(limb_files, is_renamed):
    rig = limb_files.open()
    if is_renamed:
        rig.mesh_object.vertex_groups["half.1"].name = "other"
    else:
        rig.mesh_object.vertex_groups["half.1"].add([0, 1, 2, 3], 0.5, "REPLACE")
    with pytest.raises(ModelError, match=r"was trained for another rig: the skin weights differ\. Record"):
        bind(rig, limb_files.model)


def edit_bone(rig: SceneRig, name: str, **settings: object) -> None:
    def change() -> None:
        edit_bones = rig.armature_object.data.edit_bones
        for attribute, value in settings.items():
            setattr(edit_bones[name], attribute, edit_bones[value] if attribute == "parent" else value)

    change_in_edit_mode(rig.armature_object, change)


def constraint_of(rig: SceneRig, name: str = "half.1") -> bpy.types.Constraint:
    return rig.armature_object.pose.bones[name].constraints[0]


def copy_location(rig: SceneRig, name: str, **settings: object) -> bpy.types.Constraint:
    constraint = rig.armature_object.pose.bones[name].constraints.new("COPY_LOCATION")
    constraint.target, constraint.subtarget = rig.armature_object, "bone.0"
    for attribute, value in settings.items():
        setattr(constraint, attribute, value)
    return constraint


def mute_driver(rig: SceneRig) -> None:
    rig.armature_object.animation_data.drivers.find('pose.bones["push.2"].location', index=2).mute = True
    rig.armature_object.update_tag()


HALF = "of the bone 'half.1'"

UNREAD_CHANGES = {
    "roll": (lambda r: edit_bone(r, "half.1", roll=1.2), f"'rest pose' {HALF} differs"),
    "tail": (lambda r: edit_bone(r, "push.1", tail=(0.3, 0, 0.3)), "'rest pose' of the bone 'push.1' differs"),
    "parent": (lambda r: edit_bone(r, "half.1", parent="bone.1"), f"'parent' {HALF} was bone.0 and is bone.1"),
    "scale": (
        lambda r: setattr(r.armature_object.data.bones["half.1"], "inherit_scale", "NONE"),
        f"IK' {HALF} differs",
    ),
    "muted": (lambda r: setattr(constraint_of(r), "mute", True), f"'constraints' {HALF} differs"),
    "influence": (lambda r: setattr(constraint_of(r), "influence", 0.1), f"'influences' {HALF} differs"),
    "key": (lambda r: constraint_of(r).keyframe_insert("influence", frame=1), f"'influences' {HALF} differs"),
    "target": (lambda r: setattr(constraint_of(r), "subtarget", "bone.0"), f"'constraints' {HALF} differs"),
    "axis": (lambda r: setattr(constraint_of(r), "use_x", False), f"'constraints' {HALF} differs"),
    "another": (lambda r: copy_location(r, "half.1"), f"'constraints' {HALF} differs"),
    "driver": (mute_driver, "'drivers' of the bone 'push.2' differs"),
}


@pytest.mark.parametrize("what", UNREAD_CHANGES)
def test_a_change_of_a_bone_that_is_not_read_shows_the_rig(limb_files, what):
    rig = limb_files.open()
    bind(rig, limb_files.model)
    pose_limb(rig.armature_object)
    assert_plays(rig.mesh_object, limb_files.model)
    change, clause = UNREAD_CHANGES[what]
    change(rig)
    trigger_check("view layer")
    assert rig.mesh_object.fdda.mode == "RIG" and clause in rig.mesh_object.fdda.status


def key_influence(rig: SceneRig) -> None:
    constraint = copy_location(rig, "bone.2", influence=0.2)
    for frame in (1, 20):
        constraint.keyframe_insert("influence", frame=frame)


FOLLOWED_CHANGES = {
    "a constraint of a joint": lambda r: copy_location(r, "bone.1", influence=0.3),
    "a keyed influence of a joint": key_influence,
    "a muted constraint": lambda r: copy_location(r, "half.1", mute=True),
    "a constraint without influence": lambda r: copy_location(r, "half.1", influence=0),
    "another name": lambda r: setattr(constraint_of(r), "name", "other"),
    "IK settings without IK": lambda r: setattr(r.armature_object.pose.bones["half.1"], "ik_stiffness_x", 0.3),
    "another place": lambda r: setattr(r.armature_object, "location", (100, 0, 3)),
    "a still bone": lambda r: add_bones(r.armature_object, NewBone("new", (0, 0, 1), (0, 0, 2), "bone.0", False)),
}


@pytest.mark.parametrize("what", FOLLOWED_CHANGES)
def test_a_change_that_the_model_follows_or_that_has_no_effect_keeps_it_playing(limb_files, what):
    rig = limb_files.open()
    bind(rig, limb_files.model)
    pose_limb(rig.armature_object)
    FOLLOWED_CHANGES[what](rig)
    trigger_check("view layer")
    pose_limb(rig.armature_object)
    trigger_check("frame")
    assert_plays(rig.mesh_object, limb_files.model)
    # The whole rig is read again.
    rig.mesh_object.data.update()
    session.passed_checks.clear()
    trigger_check("view layer")
    assert_plays(rig.mesh_object, limb_files.model)


def test_bones_that_move_only_bones_that_are_not_read_are_compared():
    """`shared` moves a joint, too, so the model sees what it does; `control` is an input of the model."""
    rig = build_limb()
    places = {"mechanism": 0.1, "above": 0.2, "shared": 0.3, "control": 0.4, "pole": 0.5}
    add_bones(rig.armature_object, *(NewBone(name, (x, 0, 1), (x, 0, 1.1), "", False) for name, x in places.items()))
    edit_bone(rig, "mechanism", parent="above")
    copy_location(rig, "half.1", subtarget="mechanism")
    copy_location(rig, "half.2", subtarget="control")
    copy_location(rig, "push.1", subtarget="shared")
    copy_location(rig, "bone.2", subtarget="shared")
    chain = rig.armature_object.pose.bones["push.2"].constraints.new("IK")
    chain.target = chain.pole_target = rig.armature_object
    chain.subtarget, chain.pole_subtarget, chain.chain_count = "bone.0", "pole", 1
    controls = (Control("armature_object", 'pose.bones["control"].location[0]', -1, 1),)
    rig_data = dataclasses.replace(read_rig(rig), controls=controls)
    bones = describe_bones(rig, rig_data, (), ())
    unread = find_unread_bones(bones.sources, bones.controlled, rig_data, MAIN_BONES)
    assert unread == sorted([*HELPERS, "mechanism", "above", "pole"]) and set(unread) <= bones.settings.keys()


@pytest.mark.parametrize("owner", ["object", "keys", "armature"])
def test_drivers_of_bones_that_read_a_mesh_are_equal_for_each_mesh_of_the_character(owner):
    """A recording reads the bones with all meshes, and playback may read them with any."""
    rig = build_limb()
    shirt = rig.mesh_object.copy()
    shirt.data = rig.mesh_object.data.copy()
    bpy.context.scene.collection.objects.link(shirt)
    shirt.shape_key_add(name="Basis")
    shirt.shape_key_add(name="wide")
    variable = rig.armature_object.animation_data.drivers[0].driver.variables.new()
    variable.type, target = "SINGLE_PROP", variable.targets[0]
    target.id_type, target.id, target.data_path = {
        "object": ("OBJECT", shirt, "location[0]"),
        "keys": ("KEY", shirt.data.shape_keys, 'key_blocks["wide"].value'),
        "armature": ("OBJECT", rig.armature_object, "location[0]"),
    }[owner]
    rigs = [find_rig(rig.mesh_object.name), find_rig(shirt.name)]
    readings = [read_unread_bones(each, HELPERS) for each in (*rigs, join_rigs(rigs), join_rigs(rigs[::-1]))]
    assert readings[0]["push.1"]["drivers"] or readings[0]["push.2"]["drivers"]
    assert all(reading == readings[0] for reading in readings)
    target.id_type, target.id, target.data_path = "SCENE", bpy.context.scene, "frame_current"
    assert read_unread_bones(rig, HELPERS) != readings[0]


def test_a_fast_rig_has_only_the_bones_that_the_model_reads(limb_files, tmp_path):
    fast, keyed = tmp_path / "fast.blend", tmp_path / "keyed.blend"
    rig = limb_files.open()
    for name in MAIN_BONES:
        wave(rig.armature_object, name)
    save_copy(keyed)
    assert run("fast-rig", keyed, limb_files.model, fast, "--controls", "keyed") == 0
    rig = limb_files.open()
    bind(rig, limb_files.model)
    pose_limb(rig.armature_object)
    shown = assert_plays(rig.mesh_object, limb_files.model)
    bpy.ops.wm.open_mainfile(filepath=str(fast))
    rig = find_rig("limb")
    assert {bone.name for bone in rig.armature_object.data.bones} == set(MAIN_BONES)
    pose_limb(rig.armature_object)
    np.testing.assert_allclose(assert_plays(rig.mesh_object, limb_files.model), shown, atol=1e-6)


def test_poses_are_added_at_the_worst_errors(limb_files, tmp_path):
    shutil.copytree(limb_files.recording, tmp_path / "recording")
    options = ("--refine", limb_files.model, "--poses", 6)
    assert run("record", limb_files.rig, tmp_path / "recording", *options) == 0
    recording = read_recording(tmp_path / "recording")
    assert recording.info.sampling.sources[-1].poses == 6 and len(recording.rig.joints) == 7


def test_weights_stay_with_their_joints_if_the_order_changes(tmp_path):
    """As in Rigify, the bone "tail" has a parent that copies a joint: without that parent, it comes after the joint."""
    rig = SceneRig(*limb(6, 30.0))
    add_smooth_weights(rig.mesh_object, rig.armature_object, 4, 0.05)
    add_delta_mush(rig.mesh_object, 2)
    copied = rig.armature_object.data.bones["bone.4"]
    ends = tuple(copied.head_local), tuple(copied.tail_local)
    add_bones(rig.armature_object, NewBone("copy", *ends, "bone.0"), NewBone("tail", *ends, "copy"))
    bones = rig.armature_object.pose.bones
    constraint = bones["copy"].constraints.new("COPY_TRANSFORMS")
    constraint.target, constraint.subtarget = rig.armature_object, "bone.4"
    bones["tail"].rotation_mode = "XYZ"
    limit(bones["tail"], "LIMIT_ROTATION", {0: (-40.0, 40.0)})
    positions = rest_positions(rig.mesh_object.data)
    far = np.flatnonzero(positions[:, 0] > np.quantile(positions[:, 0], 0.9)).tolist()
    rig.mesh_object.vertex_groups.new(name="tail").add(far, 0.5, "REPLACE")
    all_names = read_rig(rig).joint_names
    info = trained(rig, tmp_path / "files")
    assert "copy" in all_names and "copy" not in info.joint_names and "tail" in info.joint_names
    evaluation = drain(evaluate(rig, tmp_path / "files" / "model.onnx", EvaluationSettings(20)))
    fit = SkinFit.from_json(info.training["fit"])
    assert evaluation.linear.rms < 1.5 * fit.training.rms_mm["fitted"]


def test_a_root_that_follows_another_is_moved_with_it(tmp_path):
    """As in Rigify, constraints attach "bone.0" and the removed bone "pin" to the bone "world", which moves all."""
    rig = build_limb()
    armature_object = rig.armature_object
    ends = (0.0, 0.0, 0.0), (0.1, 0.0, 0.0)
    add_bones(armature_object, NewBone("world", *ends), NewBone("pin", *ends), NewBone("fin", *ends, "world"))
    bones = armature_object.pose.bones
    for name in ("bone.0", "pin"):
        constraint = bones[name].constraints.new("ARMATURE")
        target = constraint.targets.new()
        target.target, target.subtarget = armature_object, "world"
    for name in ("world", "fin"):
        limit(bones[name], "LIMIT_ROTATION", {0: (-40.0, 40.0), 1: (-40.0, 40.0), 2: (-40.0, 40.0)})
    for number, name in enumerate(("pin", "fin")):
        rig.mesh_object.vertex_groups.new(name=name).add(range(number, 200, 2), 0.5, "REPLACE")
    info = trained(rig, tmp_path / "files")
    names = info.joint_names
    assert {"world", "bone.0"} <= set(names) and "pin" not in names
    influences = {names[joint] for partition in info.partitions for joint in partition.influencing}
    assert influences and influences.isdisjoint({"world", "bone.0"})


def test_the_sidebar_trains_with_other_joints_without_recording_again(tmp_path):
    rig = build_limb()
    settings, files = rig.mesh_object.fdda.settings, (tmp_path / "recording", tmp_path / "model.onnx")
    settings.poses, settings.passes = 160, 1
    assert bpy.ops.fdda.record(object="limb", folder=str(files[0])) == {"FINISHED"}
    recorded = (files[0] / "recording.json").read_bytes()
    sampling = read_index(files[0])["sampling"]
    sampling["sources"] = [source for source in sampling["sources"] if source["kind"] != "alone"]
    for joints, base_skinning, joint_count in (("AUTO", "RIG", 3), ("NUMBER", "HARD", 5)):
        settings.bones_to_read, settings.bone_count, settings.base_skinning = joints, 5, base_skinning
        content = read_folder(files[0], read_rig(rig), sampling)
        assert (content.state, content.sentence) == (FolderState.COMPLETE, "")
        paths = {"recording": str(files[0]), "model": str(files[1])}
        assert bpy.ops.fdda.train(object="limb", **paths) == {"FINISHED"}
        info = read_model_info(files[1])
        assert len(info.joints) == joint_count
        assert info.training["fit"]["kind"] == {"AUTO": "smooth", "NUMBER": "hard"}[joints]
        bind(rig, files[1])
        pose_limb(rig.armature_object)
        assert_plays(rig.mesh_object, files[1])
        unbind(rig.mesh_object)
    assert (files[0] / "recording.json").read_bytes() == recorded
    rig.mesh_object.vertex_groups["half.1"].add([0, 1, 2, 3], 0.5, "REPLACE")
    changed = read_folder(files[0], read_rig(rig))
    assert changed.state is FolderState.OTHER and "the skin weights differ" in changed.sentence
