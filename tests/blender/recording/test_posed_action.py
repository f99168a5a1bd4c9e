# SPDX-License-Identifier: GPL-3.0-or-later
"""An action of poses shows the surface that was recorded, pose by pose, and Blender's exporters write it."""

from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Vector

from fdda_addon.core.recording.reader import read_recording
from fdda_addon.scene.animated_values import animated_values

from ..baked_files import world_positions
from ..conftest import ELBOW, ELBOW_RIG, evaluated_positions, run
from ..refusals import save_elbow

POSES = 12


def add_controls(rig) -> None:
    """Add a shape key, and one that a driver sets."""
    mesh_object = rig.mesh_object
    mesh_object.shape_key_add(name="Basis")
    for name, factor in (("Fat", 1.3), ("Thin", 0.8)):
        key = mesh_object.shape_key_add(name=name)
        for vertex in key.data:
            vertex.co *= factor
    driver = mesh_object.data.shape_keys.driver_add('key_blocks["Thin"].value').driver
    driver.type, driver.expression = "SCRIPTED", "0.25"


@pytest.fixture(params=["QUATERNION", "AXIS_ANGLE", "ZYX"])
def files(request, tmp_path) -> tuple[Path, Path]:
    """The paths of an elbow with controls, and of a recording of random poses and its action."""

    def change(rig) -> None:
        add_controls(rig)
        bpy.context.scene.render.frame_map_new = 150
        for bone in rig.armature_object.pose.bones:
            bone.rotation_mode = request.param

    rig = save_elbow(tmp_path / "rig.blend", change)
    options = ("--poses", POSES, "--action", "elbow_wave", "--extra-input", "Fat", "--extra-input", "Thin")
    # The action moves no bone of another rotation mode.
    options += ("--bones-to-pose", "remix") if request.param == "ZYX" else ()
    assert run("record", rig, tmp_path / "recording", *options) == 0
    return rig, tmp_path / "recording"


def test_each_frame_shows_a_recorded_pose(files, tmp_path, capfd):
    rig, recording = files
    out = tmp_path / "poses.blend"
    capfd.readouterr()
    assert run("poses", rig, out, "--recording", recording) == 0
    count = POSES + 30
    text = capfd.readouterr().out
    assert 'Keyed, with their drivers muted: shape_keys/key_blocks["Thin"].value.' in text
    assert f"{out}: {count} poses in the action 'Poses', after the rest pose in frame 0" in text
    recorded = read_recording(recording)
    bpy.ops.wm.open_mainfile(filepath=str(out))
    scene, mesh_object = bpy.context.scene, bpy.data.objects[ELBOW]
    assert (scene.frame_start, scene.frame_end) == (0, count)
    for pose in range(count):
        scene.frame_set(pose + 1)
        shown = evaluated_positions(mesh_object)
        assert np.abs(shown - recorded.positions[pose]).max() < 1e-5, pose
    scene.frame_set(0)
    bones = bpy.data.objects[ELBOW_RIG].pose.bones
    assert all(np.abs(np.array(bone.matrix_basis) - np.eye(4)).max() == 0 for bone in bones)
    keyed = animated_values(bpy.data.objects[ELBOW_RIG], [bpy.data.actions["Poses"]])
    modes = {bone.rotation_mode for bone in bones}
    expected = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}.get(*modes, "rotation_euler")
    assert {path.rpartition(".")[2] for path in keyed if "rotation" in path} == {expected}


def test_random_poses_are_exported_as_fbx_and_alembic(tmp_path):
    """Both files have the same frames, vertices in one order and the rest pose of the mesh."""
    rig, out = save_elbow(tmp_path / "rig.blend"), tmp_path / "poses.blend"
    assert run("poses", rig, out, "--poses", POSES) == 0
    bpy.ops.wm.open_mainfile(filepath=str(out))
    scene, mesh_object = bpy.context.scene, bpy.data.objects[ELBOW]
    scene.render.fps, frames = 30, range(POSES + 1)
    shown = world_positions(mesh_object, frames)
    mesh_object.modifiers["CorrectiveSmooth"].show_viewport = False
    skinned = world_positions(mesh_object, frames)
    rest = np.array([mesh_object.matrix_world @ vertex.co for vertex in mesh_object.data.vertices])
    assert np.abs(skinned[0] - rest).max() < 1e-6 < 1e-3 < np.abs(shown - skinned).max()
    bpy.ops.export_scene.fbx(
        filepath=str(tmp_path / "a.fbx"),
        object_types={"MESH", "ARMATURE"},
        use_mesh_modifiers=False,
        add_leaf_bones=False,
        bake_anim_use_all_actions=False,
        bake_anim_use_nla_strips=False,
        bake_anim_simplify_factor=0.0,
    )
    bpy.ops.wm.alembic_export(filepath=str(tmp_path / "a_surface.abc"), start=0, end=POSES)
    for path, expected in ((tmp_path / "a.fbx", skinned), (tmp_path / "a_surface.abc", shown)):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.context.scene.render.fps = 30
        if path.suffix == ".fbx":
            bpy.ops.import_scene.fbx(filepath=str(path), anim_offset=0.0)
            (action,) = bpy.data.actions
            assert tuple(action.frame_range) == (0, POSES)
        else:
            bpy.ops.wm.alembic_import(filepath=str(path))
            assert (bpy.context.scene.frame_start, bpy.context.scene.frame_end) == (0, POSES)
        (mesh_object,) = (o for o in bpy.data.objects if o.type == "MESH")
        assert np.abs(world_positions(mesh_object, frames) - expected).max() < 1e-4


@pytest.mark.one_blender_version
@pytest.mark.parametrize(
    ("options", "change"),
    [(["--action", "elbow_wave"], (10, 0)), (["--bones-to-pose", "remix"], (0, 0.1))],
    ids=["frames", "limbs"],
)
def test_poses_that_differ_from_the_recording_are_refused(refusal, tmp_path, options, change):
    """Limbs may come from an action whose frames are not recorded."""
    rig, recording = save_elbow(tmp_path / "rig.blend"), tmp_path / "recording"
    assert run("record", rig, recording, "--poses", 4, *options) == 0
    assert run("poses", rig, tmp_path / "a.blend", "--recording", recording, "--poses", 3) == 2
    assert run("poses", rig, tmp_path / "a.blend", "--recording", recording) == 0
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    for curve in bpy.data.actions["elbow_wave"].layers[0].strips[0].channelbags[0].fcurves:
        curve.keyframe_points[-1].co += Vector(change)
    bpy.ops.wm.save_mainfile()
    text = refusal("poses", rig, tmp_path / "b.blend", "--recording", recording)
    assert "'elbow' does not give the recorded poses any more: its actions or locked axes have changed" in text


def test_the_operator_keys_the_poses_of_the_sidebar(rig):
    bpy.context.view_layer.objects.active = rig.mesh_object
    rig.mesh_object.fdda.settings.poses = POSES
    assert bpy.ops.fdda.poses_to_action() == {"FINISHED"}
    scene, animation = bpy.context.scene, rig.armature_object.animation_data
    assert (scene.frame_start, scene.frame_end, animation.action.name) == (0, POSES, "Poses")
    shown = world_positions(rig.mesh_object, range(POSES + 1))
    assert (np.abs(np.diff(shown, axis=0)).max(axis=(1, 2)) > 1e-3).all()
