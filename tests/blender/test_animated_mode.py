# SPDX-License-Identifier: GPL-3.0-or-later
"""Mode and strength set by hand, by keyframes and by drivers."""

import bpy
import numpy as np
import pytest

from .conftest import assert_plays, evaluated_positions, pose
from .test_evaluations import shown_in
from .test_renders import FRAME, animation, set_camera


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


def test_a_mode_set_by_hand_shows_at_once(bound_elbow, elbow_files):
    pose(angle=1.1)
    graph = bpy.context.view_layer.depsgraph
    for mode in ("RIG", "FDDA", "LINEAR", "RIG", "LINEAR", "FDDA"):
        bound_elbow.fdda.mode = mode
        bpy.context.view_layer.update()
        drawn_positions = shown_in(graph, bound_elbow)
        assert np.array_equal(drawn_positions, evaluated_positions(bound_elbow)), mode
    assert_plays(bound_elbow, elbow_files.model)


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
    from fdda_addon.scene.compatibility import curves_of

    return curves_of(mesh_object.animation_data.action, mesh_object)


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
