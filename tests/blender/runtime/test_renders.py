# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders show the true rig, or the model where the user asks for it: compared pixel by pixel."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from ..conftest import ELBOW_RIG, assert_plays, predicted_positions

FRAME = 22
"""Frame of the action in which the elbow is strongly bent."""


@pytest.fixture
def camera(bound_elbow):
    return set_camera()


def set_camera() -> bpy.types.Object:
    """Add a camera that shows the elbow, and set the frame."""
    scene = bpy.context.scene
    scene.render.engine = "BLENDER_WORKBENCH"
    scene.render.resolution_x, scene.render.resolution_y = 160, 120
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.type, camera.data.ortho_scale = "ORTHO", 0.9
    camera.location, camera.rotation_euler = (0.25, -2, 0), (np.pi / 2, 0, 0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.frame_set(FRAME)
    return camera


def still(path: Path) -> np.ndarray:
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return pixels(path)


def animation(folder: Path) -> dict[int, np.ndarray]:
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = FRAME - 1, FRAME + 1
    scene.render.filepath = str(folder / "frame_")
    bpy.ops.render.render(animation=True)
    return {f: pixels(folder / f"frame_{f:04}.png") for f in range(scene.frame_start, scene.frame_end + 1)}


def pixels(path: Path) -> np.ndarray:
    image = bpy.data.images.load(str(path))
    values = np.array(image.pixels[:], np.float32)
    bpy.data.images.remove(image)
    return values


def render_positions(bound_elbow: bpy.types.Object, positions: np.ndarray, path: Path) -> np.ndarray:
    """Render a plain mesh of these positions in place of the bound object."""
    mesh = bound_elbow.data.copy()
    mesh.attributes["position"].data.foreach_set("vector", positions.reshape(-1))
    mesh.update()
    plain = bpy.data.objects.new("plain", mesh)
    plain.matrix_world = bound_elbow.matrix_world
    bpy.context.scene.collection.objects.link(plain)
    bound_elbow.hide_render = True
    try:
        return still(path)
    finally:
        bound_elbow.hide_render = False
        bpy.data.objects.remove(plain)


def rig_pixels(bound_elbow: bpy.types.Object, tmp_path: Path) -> np.ndarray:
    bound_elbow.fdda.mode = "RIG"
    rendered = still(tmp_path / "rig.png")
    bound_elbow.fdda.mode = "FDDA"
    return rendered


def test_still_shows_the_rig(bound_elbow, camera, tmp_path, elbow_files):
    assert np.array_equal(still(tmp_path / "still.png"), rig_pixels(bound_elbow, tmp_path))
    assert_plays(bound_elbow, elbow_files.model)


def test_still_shows_the_model_when_asked(bound_elbow, camera, tmp_path, elbow_files):
    bound_elbow.fdda.use_in_render = True
    model = render_positions(bound_elbow, predicted_positions(bound_elbow, elbow_files.model), tmp_path / "plain.png")
    assert np.array_equal(still(tmp_path / "still.png"), model)
    assert not np.array_equal(model, rig_pixels(bound_elbow, tmp_path))


def test_animation_shows_the_rig(bound_elbow, camera, tmp_path, elbow_files):
    frames = animation(tmp_path)
    bpy.context.view_layer.update()
    assert_plays(bound_elbow, elbow_files.model)
    for frame, rendered in frames.items():
        bpy.context.scene.frame_set(frame)
        assert np.array_equal(rendered, rig_pixels(bound_elbow, tmp_path)), frame


def test_animation_shows_the_model_when_asked(bound_elbow, camera, tmp_path, elbow_files):
    bound_elbow.fdda.use_in_render = True
    frames = animation(tmp_path)
    assert bpy.context.scene.frame_current == FRAME
    bpy.context.view_layer.update()
    assert_plays(bound_elbow, elbow_files.model)
    for frame, rendered in frames.items():
        bpy.context.scene.frame_set(frame)
        model = render_positions(
            bound_elbow, predicted_positions(bound_elbow, elbow_files.model), tmp_path / "plain.png"
        )
        assert np.array_equal(rendered, model), frame
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
