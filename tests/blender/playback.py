# SPDX-License-Identifier: GPL-3.0-or-later
"""Crowds, renders of the elbow as pixels, what another add-on evaluates, and a shape key unknown to the model."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np
import pytest

from fdda_addon.runtime.binding import bind
from fdda_addon.runtime.model_files import model_path
from fdda_addon.runtime.network import Execution
from fdda_addon.scene.scene_rig import SceneRig, armature_modifier, armature_of

from .conftest import without_deformation


@contextmanager
def handler(name: str, function) -> Iterator[None]:
    """Register a handler, as another add-on does, while the `with` block runs."""
    handlers = getattr(bpy.app.handlers, name)
    handlers.append(function)
    try:
        yield
    finally:
        handlers.remove(function)


def shown_in(graph: bpy.types.Depsgraph, mesh_object: bpy.types.Object) -> np.ndarray:
    mesh = mesh_object.evaluated_get(graph).data
    return np.array([vertex.co[:] for vertex in mesh.vertices], np.float32)


def add_shape_key(bound_elbow: bpy.types.Object) -> bpy.types.Object:
    """Add a shape key that the model was not trained with to the bound elbow, and return the elbow."""
    bind(SceneRig(bound_elbow, armature_of(bound_elbow)), without_deformation(model_path(bound_elbow)))
    bound_elbow.fdda.mode = "RIG"
    bound_elbow.shape_key_add(name="Basis")
    key = bound_elbow.shape_key_add(name="bulge")
    for point in key.data:
        point.co.z *= 1.2
    key.value = 1.0
    bound_elbow.fdda.mode = "FDDA"
    bpy.context.view_layer.update()
    return bound_elbow


def crowd_of(first: bpy.types.Object, count: int) -> list[bpy.types.Object]:
    """Return a bound object and copies of it, each with a separate armature in a different pose."""
    crowd = [first]
    for _ in range(count - 1):
        mesh_copy, armature_copy = first.copy(), armature_modifier(first).object.copy()
        for copy in (mesh_copy, armature_copy):
            bpy.context.scene.collection.objects.link(copy)
        armature_modifier(mesh_copy).object = armature_copy
        mesh_copy.parent = armature_copy if first.parent else None
        crowd.append(mesh_copy)
    bpy.context.view_layer.update()
    for number, mesh_object in enumerate(crowd):
        armature_modifier(mesh_object).object.pose.bones["lower"].rotation_euler[0] = 0.1 + 1.2 * number / count
    return crowd


def count_calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    counted, real = [], Execution.run

    def run(execution: Execution) -> np.ndarray:
        counted.append(len(execution.poses))
        return real(execution)

    monkeypatch.setattr(Execution, "run", run)
    return counted


def animate(crowd: list[bpy.types.Object]) -> None:
    """Animate the elbow of each character, starting from its current angle."""
    for mesh_object in crowd:
        armature_object = armature_modifier(mesh_object).object
        armature_object.animation_data_clear()
        bone = armature_object.pose.bones["lower"]
        start = bone.rotation_euler[0]
        for frame, angle in ((1, start), (60, start + 0.5)):
            bone.rotation_euler[0] = angle
            bone.keyframe_insert("rotation_euler", index=0, frame=frame)


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
