# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders of the elbow, as pixels."""

from pathlib import Path

import bpy
import numpy as np

FRAME = 22
"""Frame of the action in which the elbow is strongly bent."""


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
