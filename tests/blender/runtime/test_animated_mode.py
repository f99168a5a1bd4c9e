# SPDX-License-Identifier: GPL-3.0-or-later
"""Mode and strength set by hand, by keyframes and by drivers."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

import fdda_addon
from fdda_addon.runtime.binding import bind
from fdda_addon.runtime.session import session
from fdda_addon.runtime.transitions import State
from fdda_addon.scene.scene_rig import find_rig

from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions
from ..evaluations import shown_in
from ..rendering import FRAME, animation, set_camera
from ..rig_changes import change_in_edit_mode


def key_mode(mesh_object: bpy.types.Object, modes: dict[int, str]) -> None:
    for frame, mode in modes.items():
        mesh_object.fdda.mode = mode
        mesh_object.keyframe_insert("fdda.mode", frame=frame)


def test_keyed_modes_show_like_modes_set_by_hand(bound_elbow, elbow_files):
    key_mode(bound_elbow, {1: "FDDA", 8: "LINEAR", 12: "RIG", 16: "FDDA", 20: "RIG", 24: "LINEAR"})
    shown = {}
    for frame in (3, 9, 13, 17, 21, 25, 13, 3):
        bpy.context.scene.frame_set(frame)
        # The viewport draws these positions without another evaluation.
        shown[frame] = shown_in(bpy.context.view_layer.depsgraph, bound_elbow)
        assert np.array_equal(evaluated_positions(bound_elbow), shown[frame])
        if bound_elbow.fdda.mode == "FDDA":
            assert_plays(bound_elbow, elbow_files.model)
    bound_elbow.animation_data_clear()
    for frame, mode in ((3, "FDDA"), (9, "LINEAR"), (13, "RIG"), (17, "FDDA"), (21, "RIG"), (25, "LINEAR")):
        bpy.context.scene.frame_set(frame)
        bound_elbow.fdda.mode = mode
        bpy.context.view_layer.update()
        assert np.abs(evaluated_positions(bound_elbow) - shown[frame]).max() < 1e-6, frame
    assert not bound_elbow.fdda.status


def test_renders_follow_a_keyed_mode(bound_elbow, elbow_files, tmp_path):
    bound_elbow.fdda.use_in_render = True
    set_camera()
    bound_elbow.fdda.mode = "RIG"
    rig_images = animation(tmp_path / "rig")
    bound_elbow.fdda.mode = "FDDA"
    model_images = animation(tmp_path / "model")
    key_mode(bound_elbow, {FRAME - 1: "FDDA", FRAME: "RIG", FRAME + 1: "FDDA"})
    for curve in curves(bound_elbow):
        for point in curve.keyframe_points:
            point.interpolation = "CONSTANT"
    images = animation(tmp_path / "keyed")
    for frame, expected in ((FRAME - 1, model_images), (FRAME, rig_images), (FRAME + 1, model_images)):
        assert np.array_equal(images[frame], expected[frame]), frame
    assert not np.array_equal(rig_images[FRAME - 1], model_images[FRAME - 1])


def curves(mesh_object: bpy.types.Object) -> list[bpy.types.FCurve]:
    from fdda_addon.scene.compatibility import animation_curves

    return animation_curves(mesh_object.animation_data.action)


def remove_model(mesh_object: bpy.types.Object, path: Path) -> None:
    path.unlink()


def damage_model(mesh_object: bpy.types.Object, path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def remove_joint(mesh_object: bpy.types.Object, path: Path) -> None:
    rig = bpy.data.objects[ELBOW_RIG]
    change_in_edit_mode(rig, lambda: rig.data.edit_bones.remove(rig.data.edit_bones["lower"]))


def key_visibility(mesh_object: bpy.types.Object) -> None:
    for frame in (1, 30):
        mesh_object.modifiers["FDDA"].keyframe_insert("show_viewport", frame=frame)


def drive_mode(mesh_object: bpy.types.Object) -> None:
    mode = type(mesh_object.fdda).bl_rna.properties["mode"].enum_items["FDDA"]
    mesh_object.driver_add("fdda.mode").driver.expression = str(mode.value)


@pytest.mark.parametrize("animate", [lambda o: key_mode(o, {1: "FDDA", 30: "FDDA"}), drive_mode, key_visibility])
@pytest.mark.parametrize("spoil", [remove_model, damage_model, remove_joint])
def test_an_animated_mode_whose_model_cannot_play_reports_one_reason(
    bound_elbow, elbow_files, tmp_path, capfd, animate, spoil
):
    model, path = tmp_path / "elbow.onnx", str(tmp_path / "shot.blend")
    shutil.copy(elbow_files.model, model)
    bind(find_rig(), model)
    animate(bound_elbow)
    fdda_addon.unregister()
    spoil(bound_elbow, model)
    bpy.ops.wm.save_as_mainfile(filepath=path)
    fdda_addon.register()
    capfd.readouterr()
    bpy.ops.wm.open_mainfile(filepath=path)
    mesh_object = bpy.data.objects[ELBOW]
    for frame in (7, 8, 9):
        bpy.context.scene.frame_set(frame)
        session.needs_scan = True
        bpy.context.view_layer.update()
        assert session.character_of(mesh_object).state == State.FAILED
        assert [modifier.show_viewport for modifier in mesh_object.modifiers[:2]] == [True, True]
    output = capfd.readouterr()
    assert "Traceback" not in output.err and output.out.count("switched off") == 1
    assert mesh_object.fdda.status in output.out


@pytest.mark.parametrize("is_driven", [False, True], ids=["keyed", "driven"])
def test_an_animated_strength_blends_linear_skinning_with_the_model(bound_elbow, elbow_files, is_driven):
    if is_driven:
        curve = bound_elbow.driver_add("fdda.strength")
        curve.driver.expression = "min(1, frame / 20)"
    else:
        for frame, strength in ((0, 0.0), (20, 1.0)):
            bound_elbow.fdda.strength = strength
            bound_elbow.keyframe_insert("fdda.strength", frame=frame)
        for curve in curves(bound_elbow):
            for point in curve.keyframe_points:
                point.interpolation = "LINEAR"
    shown = {}
    for frame in (5, 10, 20):
        bpy.context.scene.frame_set(frame)
        shown[frame] = evaluated_positions(bound_elbow)
    assert_plays(bound_elbow, elbow_files.model)
    bound_elbow.animation_data_clear()
    for frame, positions in shown.items():
        bpy.context.scene.frame_set(frame)
        bound_elbow.fdda.strength = 1
        model_positions = assert_plays(bound_elbow, elbow_files.model)
        bound_elbow.fdda.strength = 0
        linear_positions, strength = evaluated_positions(bound_elbow), min(1, frame / 20)
        expected = linear_positions + strength * (model_positions - linear_positions)
        assert np.abs(positions - expected).max() < 1e-6
