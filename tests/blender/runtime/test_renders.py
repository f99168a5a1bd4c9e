# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders, exports for renders and bakes show the true rig, or the model where the user asks for it."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from ..conftest import ELBOW_RIG, assert_plays, evaluated_positions, pose, predicted_positions
from ..playback import FRAME, add_shape_key, animation, handler, render_positions, rig_pixels, set_camera, still


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


OBJ_DIGITS = 2e-6
"""Tolerance in meters, because an OBJ file stores six digits."""


@pytest.fixture(params=[False, True], ids=["rig in renders", "model in renders"])
def character(request, bound_elbow, elbow_files) -> tuple[bpy.types.Object, np.ndarray, np.ndarray]:
    """The elbow with a shape key, posed; what renders show of it and what they do not."""
    add_shape_key(bound_elbow).fdda.use_in_render = request.param
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    pose(angle=1.1)
    model = assert_plays(bound_elbow, elbow_files.model)
    bound_elbow.fdda.mode = "RIG"
    rig = evaluated_positions(bound_elbow)
    bound_elbow.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    return (bound_elbow, model, rig) if request.param else (bound_elbow, rig, model)


def test_an_obj_export_has_the_rendered_deformation(character, tmp_path):
    _, shown, other = character
    path = tmp_path / "elbow.obj"
    axes = {"forward_axis": "Y", "up_axis": "Z"}
    bpy.ops.wm.obj_export(filepath=str(path), export_eval_mode="DAG_EVAL_RENDER", **axes)
    lines = [line.split()[1:4] for line in path.read_text().splitlines() if line.startswith("v ")]
    positions = np.array(lines, np.float64)
    assert np.abs(positions - shown).max() < OBJ_DIGITS and np.abs(positions - other).max() > 1e-3


def test_a_cycles_bake_has_the_rendered_deformation(character):
    """Cycles bakes the position of each vertex into a color attribute."""
    bound_path, shown, other = character
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    colors = bound_path.data.attributes.new("baked", "FLOAT_COLOR", "POINT")
    bound_path.data.attributes.active_color = colors
    if not bound_path.data.materials:
        bound_path.data.materials.append(bpy.data.materials.new("plain"))
    bpy.ops.object.select_all(action="DESELECT")
    bound_path.select_set(True)
    bpy.context.view_layer.objects.active = bound_path
    bpy.context.view_layer.update()
    assert bpy.ops.object.bake(type="POSITION", target="VERTEX_COLORS") == {"FINISHED"}
    values = np.empty(4 * len(bound_path.data.vertices), np.float32)
    bound_path.data.attributes["baked"].data.foreach_get("color", values)
    positions = values.reshape(-1, 4)[:, :3]
    assert np.abs(positions - shown).max() < 1e-4 < 1e-3 < np.abs(positions - other).max()


def test_rendered_frames_have_poses_that_another_addon_sets(bound_elbow, tmp_path):
    """Each frame shows its own pose, not the pose of the previous frame."""
    bound_elbow.fdda.use_in_render = True
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    set_camera()
    bone = bpy.data.objects[ELBOW_RIG].pose.bones["lower"]
    expected = {}
    for frame in (FRAME - 1, FRAME, FRAME + 1):
        bpy.context.scene.frame_set(frame)
        pose(angle=frame % 3 * 0.5)
        expected[frame] = still(Path(tmp_path / f"{frame}.png"))

    def set_pose(scene, _graph):
        bone.rotation_euler[0] = scene.frame_current % 3 * 0.5

    with handler("frame_change_post", set_pose):
        rendered = animation(tmp_path)
    assert [frame for frame in expected if not np.array_equal(rendered[frame], expected[frame])] == []
    assert not np.array_equal(expected[FRAME - 1], expected[FRAME])
