# SPDX-License-Identifier: GPL-3.0-or-later
"""Mode, strength and visibility of the FDDA modifier, set by hand, by keyframes, by drivers and by other add-ons."""

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

import fdda_addon
from fdda_addon.core.errors import ModelError
from fdda_addon.runtime.binding import bind, model_disabled, temporary_mode
from fdda_addon.runtime.player import Player
from fdda_addon.runtime.session import session
from fdda_addon.runtime.transitions import State
from fdda_addon.scene.scene_rig import find_rig

from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, pose, rig_positions
from ..playback import FRAME, animation, handler, rig_pixels, set_camera, shown_in, still
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


def key_mode_in_strip(mesh_object: bpy.types.Object) -> None:
    key_mode(mesh_object, {1: "FDDA"})
    animation_data = mesh_object.animation_data
    track = animation_data.nla_tracks.new()
    strip = track.strips.new("mode", 1, animation_data.action)
    strip.extrapolation, animation_data.action = "HOLD", None


MODE_ANIMATIONS = {"keyed": lambda o: key_mode(o, {1: "FDDA"}), "driven": drive_mode, "in a strip": key_mode_in_strip}


@pytest.mark.parametrize("animation_name", MODE_ANIMATIONS)
def test_an_animated_mode_shows_the_rig_while_the_model_is_disabled(bound_elbow, elbow_files, animation_name):
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    pose(angle=1.0)
    expected = rig_positions(bound_elbow)
    MODE_ANIMATIONS[animation_name](bound_elbow)
    pose(angle=1.0)
    assert_plays(bound_elbow, elbow_files.model)
    with model_disabled(bound_elbow):
        for _ in range(3):
            pose(angle=1.0)
            assert np.array_equal(evaluated_positions(bound_elbow), expected)
        # While a job runs modally, a user can change the mode and the frame.
        bound_elbow.fdda.mode = "FDDA"
        bpy.context.scene.frame_set(7)
        pose(angle=1.0)
        assert np.array_equal(evaluated_positions(bound_elbow), expected)
    pose(angle=1.0)
    assert_plays(bound_elbow, elbow_files.model)


def disable_modifier(mesh_object: bpy.types.Object) -> None:
    mesh_object.modifiers["FDDA"].show_viewport = False


def test_disabling_the_modifier_sets_mode_rig(bound_elbow, elbow_files):
    pose(angle=1.0)
    expected = rig_positions(bound_elbow)
    bpy.context.view_layer.update()
    disable_modifier(bound_elbow)
    bpy.context.view_layer.update()
    assert np.array_equal(evaluated_positions(bound_elbow), expected)
    assert (
        bound_elbow.fdda.mode == "RIG" and "The modifier 'FDDA' of 'elbow' was switched off" in bound_elbow.fdda.status
    )
    bound_elbow.modifiers["FDDA"].show_viewport = True
    bpy.context.view_layer.update()
    pose(angle=0.7)
    assert_plays(bound_elbow, elbow_files.model)
    # This also works with a frame change, without an evaluation in between.
    disable_modifier(bound_elbow)
    bpy.context.scene.frame_set(9)
    expected = evaluated_positions(bound_elbow)
    assert bound_elbow.fdda.mode == "RIG"
    bound_elbow.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    assert np.abs(rig_positions(bound_elbow) - expected).max() < 1e-6


def test_a_driven_mode_enables_a_disabled_modifier(bound_elbow, elbow_files):
    drive_mode(bound_elbow)
    pose(angle=1.0)
    disable_modifier(bound_elbow)
    bpy.context.view_layer.update()
    assert_plays(bound_elbow, elbow_files.model)


@pytest.mark.parametrize("is_keyed", [False, True], ids=["driven", "keyed"])
def test_an_animated_visibility_of_the_modifier_is_followed(bound_elbow, elbow_files, is_keyed):
    modifier = bound_elbow.modifiers["FDDA"]
    if is_keyed:
        for frame, value in ((1, True), (10, False), (20, True)):
            modifier.show_viewport = value
            modifier.keyframe_insert("show_viewport", frame=frame)
    else:
        modifier.driver_add("show_viewport").driver.expression = "not 10 <= frame < 20"
    for frame in (5, 12, 15, 22, 11, 3):
        bpy.context.scene.frame_set(frame)
        if 10 <= frame < 20:
            shown = evaluated_positions(bound_elbow)
            with model_disabled(bound_elbow):
                bpy.context.view_layer.update()
                assert np.array_equal(evaluated_positions(bound_elbow), shown), frame
        else:
            assert_plays(bound_elbow, elbow_files.model)
    # In mode RIG, the visibility of the modifier has no effect.
    bound_elbow.fdda.mode = "RIG"
    bpy.context.scene.frame_set(22)
    shown = evaluated_positions(bound_elbow)
    bound_elbow.animation_data_clear()
    modifier.show_viewport = False
    bpy.context.view_layer.update()
    assert np.array_equal(evaluated_positions(bound_elbow), shown)


def test_disabling_the_modifier_in_renders_clears_use_in_render(bound_elbow, tmp_path):
    set_camera()
    bound_elbow.fdda.use_in_render = True
    bpy.context.view_layer.update()
    model_image = still(tmp_path / "model.png")
    bound_elbow.modifiers["FDDA"].show_render = False
    bpy.context.view_layer.update()
    assert not bound_elbow.fdda.use_in_render
    rig_image = still(tmp_path / "rig.png")
    assert np.array_equal(rig_image, rig_pixels(bound_elbow, tmp_path)) and not np.array_equal(rig_image, model_image)


@pytest.mark.parametrize("index", [0, None], ids=["before the add-on's", "after the add-on's"])
def test_a_handler_of_another_add_on_can_set_the_mode_in_renders(bound_elbow, tmp_path, index):
    bound_elbow.fdda.use_in_render = True
    set_camera()
    model_images = animation(tmp_path / "model")

    def set_mode(scene: bpy.types.Scene, _: bpy.types.Depsgraph) -> None:
        bound_elbow.fdda.mode = "RIG" if scene.frame_current < FRAME else "FDDA"

    bound_elbow.fdda.mode = "RIG"
    bpy.context.view_layer.update()
    rig_images = animation(tmp_path / "rig")
    handlers = bpy.app.handlers.frame_change_post
    with handler("frame_change_post", set_mode):
        if index is not None:
            handlers.insert(0, handlers.pop())
        images = animation(tmp_path / "mixed")
    for frame, pixels in images.items():
        assert np.array_equal(pixels, (rig_images if frame < FRAME else model_images)[frame]), frame


def test_only_mode_and_strength_can_be_animated(bound_elbow):
    from fdda_addon.properties.character import FDDA_PG_character

    groups = {"fdda": bound_elbow.fdda, "fdda.settings": bound_elbow.fdda.settings}
    animatable = {
        f"{path}.{prop.identifier}"
        for path, group in groups.items()
        for prop in group.bl_rna.properties
        if prop.is_animatable and prop.type in {"BOOLEAN", "INT", "FLOAT", "ENUM", "STRING"}
    }
    assert isinstance(bound_elbow.fdda.settings, FDDA_PG_character)
    assert animatable == {"fdda.mode", "fdda.strength"}
    with pytest.raises(TypeError, match="not animatable"):
        bound_elbow.fdda.keyframe_insert("use_in_render")


def test_a_model_that_fails_in_an_overriding_mode_is_created_once(bound_elbow, elbow_files, monkeypatch):
    """The failure sets the mode RIG, and the overriding mode must not start the model again and again."""
    create, attempts = Player.__init__, []

    def fail(*_: object) -> None:
        attempts.append(1)
        raise ModelError("The model is gone.")

    bound_elbow.fdda.mode = "RIG"
    pose(angle=1.0)
    expected = evaluated_positions(bound_elbow)
    monkeypatch.setattr(Player, "__init__", fail)
    with temporary_mode(bound_elbow, "FDDA"):
        for _ in range(3):
            pose(angle=1.0)
            assert np.array_equal(evaluated_positions(bound_elbow), expected)
    assert len(attempts) == 1 and bound_elbow.fdda.status == "The model is gone."
    monkeypatch.setattr(Player, "__init__", create)
    with temporary_mode(bound_elbow, "FDDA"):
        pose(angle=0.7)
        assert_plays(bound_elbow, elbow_files.model)
