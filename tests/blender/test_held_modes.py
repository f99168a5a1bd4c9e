# SPDX-License-Identifier: GPL-3.0-or-later
"""A mode that is keyed or driven, and the eye of the FDDA modifier: work on the rig has the rig, and shows say why."""

import json

import bpy
import numpy as np
import pytest

from fdda_addon.runtime.binding import model_disabled
from fdda_addon.scene.blend_file import save_copy

from .conftest import ELBOW_RIG, assert_plays, evaluated, pose, rig_positions, run
from .test_evaluations import handler
from .test_renders import FRAME, animation, rig_pixels, set_camera, still


def key(mesh_object: bpy.types.Object) -> None:
    mesh_object.fdda.keyframe_insert("mode", frame=1)


def drive(mesh_object: bpy.types.Object) -> None:
    mesh_object.fdda.driver_add("mode").driver.expression = "2"


def key_in_strip(mesh_object: bpy.types.Object) -> None:
    key(mesh_object)
    animation_data = mesh_object.animation_data
    track = animation_data.nla_tracks.new()
    strip = track.strips.new("mode", 1, animation_data.action)
    strip.extrapolation, animation_data.action = "HOLD", None


ANIMATED = {"keyed": key, "driven": drive, "in a strip": key_in_strip}


@pytest.mark.parametrize("how", ANIMATED)
def test_the_rig_is_held_while_it_is_borrowed(bound, elbow, how):
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    pose(angle=1.0)
    expected = rig_positions(bound)
    ANIMATED[how](bound)
    pose(angle=1.0)
    assert_plays(bound, elbow.model)
    with model_disabled(bound):
        for _ in range(3):
            pose(angle=1.0)
            assert np.array_equal(evaluated(bound), expected)
        # As a job is in a window, beside a user.
        bound.fdda.mode = "FDDA"
        bpy.context.scene.frame_set(7)
        pose(angle=1.0)
        assert np.array_equal(evaluated(bound), expected)
    pose(angle=1.0)
    assert_plays(bound, elbow.model)


def test_an_evaluation_compares_with_the_rig(bound, elbow, tmp_path):
    path, figures = tmp_path / "bound.blend", {}
    for name, animate in (("plain", lambda _: None), ("driven", drive)):
        animate(bound)
        bpy.context.view_layer.update()
        save_copy(path)
        report = tmp_path / f"{name}.json"
        assert run("evaluate", path, elbow.model, "--poses", 3, "--json", report) == 0
        figures[name] = json.loads(report.read_text())
        bpy.ops.wm.open_mainfile(filepath=str(elbow.bound))
        bound = bpy.data.objects["elbow"]
    assert figures["driven"]["fdda"] == figures["plain"]["fdda"]


def hide(mesh_object: bpy.types.Object) -> None:
    mesh_object.modifiers["FDDA"].show_viewport = False


def test_the_eye_of_the_modifier_is_the_switch(bound, elbow):
    pose(angle=1.0)
    expected = rig_positions(bound)
    bpy.context.view_layer.update()
    hide(bound)
    bpy.context.view_layer.update()
    assert np.array_equal(evaluated(bound), expected)
    assert bound.fdda.mode == "RIG" and "The modifier 'FDDA' of 'elbow' was switched off" in bound.fdda.status
    bound.modifiers["FDDA"].show_viewport = True
    bpy.context.view_layer.update()
    pose(angle=0.7)
    assert_plays(bound, elbow.model)
    # Also with a frame, and where no evaluation was in between.
    hide(bound)
    bpy.context.scene.frame_set(9)
    expected = evaluated(bound)
    assert bound.fdda.mode == "RIG"
    bound.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    assert np.abs(rig_positions(bound) - expected).max() < 1e-6


def test_the_eye_goes_with_a_mode_that_is_driven(bound, elbow):
    drive(bound)
    pose(angle=1.0)
    hide(bound)
    bpy.context.view_layer.update()
    assert_plays(bound, elbow.model)


@pytest.mark.parametrize("is_keyed", [False, True], ids=["driven", "keyed"])
def test_an_eye_that_is_animated_is_followed(bound, elbow, is_keyed):
    modifier = bound.modifiers["FDDA"]
    if is_keyed:
        for frame, value in ((1, True), (10, False), (20, True)):
            modifier.show_viewport = value
            modifier.keyframe_insert("show_viewport", frame=frame)
    else:
        modifier.driver_add("show_viewport").driver.expression = "not 10 <= frame < 20"
    for frame in (5, 12, 15, 22, 11, 3):
        bpy.context.scene.frame_set(frame)
        if 10 <= frame < 20:
            shown = evaluated(bound)
            with model_disabled(bound):
                bpy.context.view_layer.update()
                assert np.array_equal(evaluated(bound), shown), frame
        else:
            assert_plays(bound, elbow.model)
    # With the rig chosen, one that is shown changes nothing.
    bound.fdda.mode = "RIG"
    bpy.context.scene.frame_set(22)
    shown = evaluated(bound)
    bound.animation_data_clear()
    modifier.show_viewport = False
    bpy.context.view_layer.update()
    assert np.array_equal(evaluated(bound), shown)


def test_the_eye_in_renders_is_that_of_use_in_render(bound, tmp_path):
    set_camera()
    bound.fdda.use_in_render = True
    bpy.context.view_layer.update()
    model = still(tmp_path / "model.png")
    bound.modifiers["FDDA"].show_render = False
    bpy.context.view_layer.update()
    assert not bound.fdda.use_in_render
    rig = still(tmp_path / "rig.png")
    assert np.array_equal(rig, rig_pixels(bound, tmp_path)) and not np.array_equal(rig, model)


@pytest.mark.parametrize("place", [0, None], ids=["before ours", "after ours"])
def test_a_handler_that_lets_the_model_play_in_a_render(bound, tmp_path, place):
    bound.fdda.use_in_render = True
    set_camera()
    model = animation(tmp_path / "model")

    def play(scene: bpy.types.Scene, _: bpy.types.Depsgraph) -> None:
        bound.fdda.mode = "RIG" if scene.frame_current < FRAME else "FDDA"

    bound.fdda.mode = "RIG"
    bpy.context.view_layer.update()
    rig = animation(tmp_path / "rig")
    handlers = bpy.app.handlers.frame_change_post
    with handler("frame_change_post", play):
        if place is not None:
            handlers.insert(0, handlers.pop())
        mixed = animation(tmp_path / "mixed")
    for frame, pixels in mixed.items():
        assert np.array_equal(pixels, (rig if frame < FRAME else model)[frame]), frame


def test_only_what_is_followed_can_be_animated(bound):
    from fdda_addon.properties.character import FDDA_PG_character

    groups = {"fdda": bound.fdda, "fdda.settings": bound.fdda.settings}
    animatable = {
        f"{path}.{prop.identifier}"
        for path, group in groups.items()
        for prop in group.bl_rna.properties
        if prop.is_animatable and prop.type in {"BOOLEAN", "INT", "FLOAT", "ENUM", "STRING"}
    }
    assert isinstance(bound.fdda.settings, FDDA_PG_character)
    assert animatable == {"fdda.mode", "fdda.strength"}
    with pytest.raises(TypeError, match="not animatable"):
        bound.fdda.keyframe_insert("use_in_render")
