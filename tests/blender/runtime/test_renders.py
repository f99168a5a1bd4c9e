# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders show the true rig, or the model where the user asks for it: compared pixel by pixel."""

import bpy
import numpy as np
import pytest

from ..conftest import ELBOW_RIG, assert_plays, predicted_positions
from ..rendering import FRAME, animation, render_positions, rig_pixels, set_camera, still


@pytest.fixture
def camera(bound_elbow):
    return set_camera()


@pytest.mark.parametrize("use_in_render", [False, True])
def test_a_still_shows_the_rig_or_the_model(bound_elbow, camera, tmp_path, elbow_files, use_in_render):
    bound_elbow.fdda.use_in_render = use_in_render
    rendered, rig = still(tmp_path / "still.png"), rig_pixels(bound_elbow, tmp_path)
    assert_plays(bound_elbow, elbow_files.model)
    model = render_positions(bound_elbow, predicted_positions(bound_elbow, elbow_files.model), tmp_path / "plain.png")
    expected, other = (model, rig) if use_in_render else (rig, model)
    assert np.array_equal(rendered, expected) and not np.array_equal(rendered, other)


@pytest.mark.parametrize("use_in_render", [False, True])
def test_an_animation_shows_the_rig_or_the_model(bound_elbow, camera, tmp_path, elbow_files, use_in_render):
    bound_elbow.fdda.use_in_render = use_in_render
    frames = animation(tmp_path)
    assert bpy.context.scene.frame_current == FRAME
    bpy.context.view_layer.update()
    assert_plays(bound_elbow, elbow_files.model)
    for frame, rendered in frames.items():
        bpy.context.scene.frame_set(frame)
        model = predicted_positions(bound_elbow, elbow_files.model)
        expected = (
            render_positions(bound_elbow, model, tmp_path / "plain.png")
            if use_in_render
            else rig_pixels(bound_elbow, tmp_path)
        )
        assert np.array_equal(rendered, expected), frame
    assert not np.array_equal(frames[FRAME - 1], frames[FRAME + 1])


def test_render_of_a_posed_armature_without_action(bound_elbow, camera, tmp_path, elbow_files):
    armature_object = bpy.data.objects[ELBOW_RIG]
    armature_object.animation_data_clear()
    bound_elbow.fdda.use_in_render = True
    armature_object.pose.bones["lower"].rotation_euler[0] = 0.7
    # The scene is not updated here, because the render must evaluate the pose itself.
    rendered = still(tmp_path / "still.png")
    bpy.context.view_layer.update()
    model = render_positions(bound_elbow, predicted_positions(bound_elbow, elbow_files.model), tmp_path / "plain.png")
    assert np.array_equal(rendered, model)
