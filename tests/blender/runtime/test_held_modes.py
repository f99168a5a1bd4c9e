# SPDX-License-Identifier: GPL-3.0-or-later
"""Animated modes and the visibility of the FDDA modifier: jobs still read the rig, and messages give reasons."""

import bpy
import numpy as np
import pytest

from fdda_addon.core.errors import ModelError
from fdda_addon.runtime.binding import model_disabled, temporary_mode
from fdda_addon.runtime.player import Player

from ..conftest import ELBOW_RIG, assert_plays, evaluated_positions, pose, rig_positions
from ..evaluations import handler
from ..rendering import FRAME, animation, rig_pixels, set_camera, still


def key_mode(mesh_object: bpy.types.Object) -> None:
    mesh_object.fdda.keyframe_insert("mode", frame=1)


def drive_mode(mesh_object: bpy.types.Object) -> None:
    mesh_object.fdda.driver_add("mode").driver.expression = "2"


def key_mode_in_strip(mesh_object: bpy.types.Object) -> None:
    key_mode(mesh_object)
    animation_data = mesh_object.animation_data
    track = animation_data.nla_tracks.new()
    strip = track.strips.new("mode", 1, animation_data.action)
    strip.extrapolation, animation_data.action = "HOLD", None


MODE_ANIMATIONS = {"keyed": key_mode, "driven": drive_mode, "in a strip": key_mode_in_strip}


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
