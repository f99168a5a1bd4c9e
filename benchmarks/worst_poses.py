# SPDX-License-Identifier: GPL-3.0-or-later
"""Render the worst poses with zebra stripes: `worst_poses.py RIG.blend MODEL.onnx OUT.png`.

The surface reflects stripes like a mirror. The reflections break at a seam or a fold even if the positions look right.
Each picture shows one held-out pose, with the rig above and the model below. The poses are those with the largest error
of a vertex. That vertex is in the middle of the picture. The camera looks along its normal; if something hides the
vertex from there, the camera takes the nearest direction that shows it.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector
from mathutils.bvhtree import BVHTree

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import fdda_addon  # noqa: E402
from fdda_addon.cli.files import open_file  # noqa: E402
from fdda_addon.evaluation.results import Evaluation  # noqa: E402
from fdda_addon.evaluation.run import evaluate  # noqa: E402
from fdda_addon.evaluation.settings import EvaluationSettings  # noqa: E402
from fdda_addon.runtime.opened_model import open_model  # noqa: E402
from fdda_addon.scene.mesh import set_mesh_positions  # noqa: E402
from fdda_addon.scene.scene_rig import SceneRig, find_rig  # noqa: E402

PICTURE_SIZE, RENDER_SAMPLES, COLUMNS, GAP = 180, 48, 5, 5
"""Width and height of a picture in pixels, samples per pixel, pictures per row, pixels between pictures."""
VIEW_RATIO = 0.16
"""Width of the view relative to the character's size."""
RAY_START_RATIO = 0.002
"""Distance from the surface at which the rays to the camera start, relative to the character's size."""
DIRECTION_COUNT = 200
"""Number of candidate directions of the camera."""
BACKGROUND_GRAY = 0.14
STRIPE_SCALE = 1.2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rig", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--poses", type=int, default=10)
    parser.add_argument("--of", type=int, default=200, help="number of held-out poses to search")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    open_file(options.rig)
    scene_rig = find_rig()
    *_, evaluation = evaluate(scene_rig, options.model, EvaluationSettings(options.of, options.seed, surface=False))
    pictures = render_worst(scene_rig, options.model, evaluation, options.poses)
    pictures += [np.zeros_like(pictures[0])] * (-len(pictures) % COLUMNS)
    rows = [np.concatenate(pictures[start : start + COLUMNS], axis=1) for start in range(0, len(pictures), COLUMNS)]
    save_png(np.concatenate(rows, axis=0), options.out)


def render_worst(scene_rig: SceneRig, model: Path, evaluation: Evaluation, count: int) -> list[np.ndarray]:
    """Render the worst poses, rig above model.

    Returns:
        (2 * PICTURE_SIZE + 3 * GAP, PICTURE_SIZE + GAP, 4) float32 of each pose, top row first.
    """
    errors, network = evaluation.held_out, open_model(scene_rig, model).network
    mesh = scene_rig.mesh_object.data.copy()
    scene = build_polished_scene(mesh)
    pictures = []
    for pose in np.argsort(errors.fdda.max(axis=1))[::-1][:count]:
        vertex = int(errors.fdda[pose].argmax())
        matrices, controls = errors.pose_matrices[pose, None], errors.controls[pose, None]
        true_positions, model_positions = errors.positions[pose], network.positions(matrices, controls)[0].copy()
        print(f"pose {pose}: vertex {vertex} is {errors.fdda[pose, vertex] * 1000:.1f} mm off", flush=True)
        set_mesh_positions(mesh, true_positions)
        mesh.update()
        aim_camera(scene.camera, mesh, vertex, float(np.ptp(true_positions, axis=0).max()))
        picture = np.zeros((2 * PICTURE_SIZE + 3 * GAP, PICTURE_SIZE + GAP, 4), np.float32)
        for top, positions in ((GAP, true_positions), (PICTURE_SIZE + 2 * GAP, model_positions)):
            set_mesh_positions(mesh, positions)
            mesh.update()
            picture[top : top + PICTURE_SIZE, :PICTURE_SIZE] = render_image(scene)
        pictures.append(picture)
    return pictures


def build_polished_scene(mesh: bpy.types.Mesh) -> bpy.types.Scene:
    """Build a scene with the mesh as a polished surface in a world of stripes."""
    scene = bpy.data.scenes.new("worst poses")
    shown = bpy.data.objects.new("shown", mesh)
    shown.shape_key_clear()
    scene.collection.objects.link(shown)
    material = bpy.data.materials.new("polished")
    if material.node_tree is None:
        material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Metallic"].default_value, shader.inputs["Roughness"].default_value = 1.0, 0.05
    mesh.materials.clear()
    mesh.materials.append(material)
    mesh.shade_smooth()
    scene.world = world = bpy.data.worlds.new("stripes")
    if world.node_tree is None:
        world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    texture_coordinates, wave_texture = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeTexWave")
    wave_texture.inputs["Scale"].default_value = STRIPE_SCALE
    wave_texture.bands_direction = "Z"
    links.new(texture_coordinates.outputs["Generated"], wave_texture.inputs["Vector"])
    links.new(wave_texture.outputs["Color"], nodes["Background"].inputs["Color"])
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.type = "ORTHO"
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = "CYCLES"
    scene.render.film_transparent = True
    scene.cycles.samples, scene.cycles.use_denoising = RENDER_SAMPLES, False
    scene.render.resolution_x = scene.render.resolution_y = PICTURE_SIZE
    scene.view_settings.view_transform = "Standard"
    return scene


def aim_camera(camera: bpy.types.Object, mesh: bpy.types.Mesh, vertex: int, size: float) -> None:
    """Point the camera at a vertex from the visible direction that is nearest to its normal."""
    position, normal = mesh.vertices[vertex].co, mesh.vertices[vertex].normal
    tree = BVHTree.FromPolygons([v.co for v in mesh.vertices], [face.vertices for face in mesh.polygons])
    directions = sorted(unit_directions(), key=normal.dot, reverse=True)
    visible_directions = (
        direction
        for direction in directions
        if tree.ray_cast(position + (normal + direction) * size * RAY_START_RATIO, direction)[0] is None
    )
    direction = next(visible_directions, normal)
    camera.location = position + direction * size
    camera.rotation_euler = (-direction).to_track_quat("-Z", "Y").to_euler()
    camera.data.ortho_scale, camera.data.clip_end = size * VIEW_RATIO, size * 4


def unit_directions() -> list[Vector]:
    """Return evenly distributed unit vectors (a spiral with the golden angle)."""
    heights = 1 - 2 * (np.arange(DIRECTION_COUNT) + 0.5) / DIRECTION_COUNT
    angles = np.arange(DIRECTION_COUNT) * np.pi * (3 - 5**0.5)
    radii = np.sqrt(1 - heights**2)
    components = [radii * np.cos(angles), radii * np.sin(angles), heights]
    return [Vector(direction) for direction in np.stack(components, axis=1).tolist()]


def render_image(scene: bpy.types.Scene) -> np.ndarray:
    """Render the scene: (PICTURE_SIZE, PICTURE_SIZE, 4) float32, top row first."""
    with tempfile.TemporaryDirectory() as folder:
        scene.render.filepath = str(Path(folder) / "picture.png")
        bpy.ops.render.render(write_still=True, scene=scene.name)
        image = bpy.data.images.load(scene.render.filepath)
        pixels = np.empty(PICTURE_SIZE * PICTURE_SIZE * 4, np.float32)
        image.pixels.foreach_get(pixels)
        bpy.data.images.remove(image)
    return pixels.reshape(PICTURE_SIZE, PICTURE_SIZE, 4)[::-1]


def save_png(pixels: np.ndarray, path: Path) -> None:
    """Write an image of (H, W, 4) float32, top row first, to a PNG file."""
    height, width = pixels.shape[:2]
    # The background is gray, a color of neither stripe.
    colors, alpha = pixels[..., :3], pixels[..., 3:]
    opaque_pixels = np.concatenate([colors * alpha + BACKGROUND_GRAY * (1 - alpha), np.ones_like(alpha)], axis=2)
    image = bpy.data.images.new("worst poses", width, height)
    image.pixels.foreach_set(np.ascontiguousarray(opaque_pixels[::-1]).ravel())
    image.filepath_raw, image.file_format = str(path.absolute()), "PNG"
    image.save(quality=95)


if __name__ == "__main__":
    fdda_addon.register()
    try:
        main()
    finally:
        fdda_addon.unregister()
