# SPDX-License-Identifier: GPL-3.0-or-later
"""The worst poses as a polished surface shows them: `worst_poses.py RIG.blend MODEL.onnx OUT.png`.

Stripes that a mirror reflects break where a surface has a seam or a fold, long before its positions are visibly off
("zebra stripes"). Rig above and model below, in the held-out poses with the largest error of a vertex. That vertex is
in the middle, seen from where it faces, or where that is hidden, from the nearest place from which it can be seen.
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
from fdda_addon.evaluation.run import Evaluation, EvaluationSettings, evaluate  # noqa: E402
from fdda_addon.runtime.opened_model import open_model  # noqa: E402
from fdda_addon.scene.mesh import set_mesh_positions  # noqa: E402
from fdda_addon.scene.scene_rig import SceneRig, find_rig  # noqa: E402

SIZE, SAMPLES, COLUMNS, GAP = 180, 48, 5, 5
SHOWN, CLOSE = 0.16, 0.002
"""How much of the mesh a picture shows, and how far outside it the search for what is in the way begins, as parts of
the character's size."""
DIRECTIONS = 200
BACKGROUND = 0.14
STRIPES = 1.2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rig", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--poses", type=int, default=10)
    parser.add_argument("--of", type=int, default=200, help="of how many held-out poses these are the worst")
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
    """(2 * SIZE + 3 * GAP, SIZE + GAP, 4) float32 of each of the worst poses, rig above model, top row first."""
    errors, network = evaluation.held_out, open_model(scene_rig, model).network
    mesh = scene_rig.mesh_object.data.copy()
    scene = build_polished_scene(mesh)
    found = []
    for pose in np.argsort(errors.fdda.max(axis=1))[::-1][:count]:
        vertex = int(errors.fdda[pose].argmax())
        matrices, controls = errors.pose_matrices[pose, None], errors.controls[pose, None]
        true, fdda = errors.positions[pose], network.positions(matrices, controls)[0].copy()
        print(f"pose {pose}: vertex {vertex} is {errors.fdda[pose, vertex] * 1000:.1f} mm off", flush=True)
        set_mesh_positions(mesh, true)
        mesh.update()
        aim_camera(scene.camera, mesh, vertex, float(np.ptp(true, axis=0).max()))
        both = np.zeros((2 * SIZE + 3 * GAP, SIZE + GAP, 4), np.float32)
        for top, positions in ((GAP, true), (SIZE + 2 * GAP, fdda)):
            set_mesh_positions(mesh, positions)
            mesh.update()
            both[top : top + SIZE, :SIZE] = render_image(scene)
        found.append(both)
    return found


def build_polished_scene(mesh: bpy.types.Mesh) -> bpy.types.Scene:
    """A scene with the mesh polished, under stripes of light."""
    scene = bpy.data.scenes.new("worst poses")
    shown = bpy.data.objects.new("shown", mesh)
    shown.shape_key_clear()
    scene.collection.objects.link(shown)
    material = bpy.data.materials.new("polished")
    if material.node_tree is None:
        material.use_nodes = True
    surface = material.node_tree.nodes["Principled BSDF"]
    surface.inputs["Metallic"].default_value, surface.inputs["Roughness"].default_value = 1.0, 0.05
    mesh.materials.clear()
    mesh.materials.append(material)
    mesh.shade_smooth()
    scene.world = world = bpy.data.worlds.new("stripes")
    if world.node_tree is None:
        world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    place, wave = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeTexWave")
    wave.inputs["Scale"].default_value = STRIPES
    wave.bands_direction = "Z"
    links.new(place.outputs["Generated"], wave.inputs["Vector"])
    links.new(wave.outputs["Color"], nodes["Background"].inputs["Color"])
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.type = "ORTHO"
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = "CYCLES"
    scene.render.film_transparent = True
    scene.cycles.samples, scene.cycles.use_denoising = SAMPLES, False
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.view_settings.view_transform = "Standard"
    return scene


def aim_camera(camera: bpy.types.Object, mesh: bpy.types.Mesh, vertex: int, size: float) -> None:
    """Look at a vertex from where it can be seen, as straight as that goes."""
    place, normal = mesh.vertices[vertex].co, mesh.vertices[vertex].normal
    tree = BVHTree.FromPolygons([v.co for v in mesh.vertices], [face.vertices for face in mesh.polygons])
    ways = sorted(unit_directions(), key=normal.dot, reverse=True)
    free = (way for way in ways if tree.ray_cast(place + (normal + way) * size * CLOSE, way)[0] is None)
    way = next(free, normal)
    camera.location = place + way * size
    camera.rotation_euler = (-way).to_track_quat("-Z", "Y").to_euler()
    camera.data.ortho_scale, camera.data.clip_end = size * SHOWN, size * 4


def unit_directions() -> list[Vector]:
    """Unit vectors all around, evenly spread (a spiral of golden angles)."""
    up = 1 - 2 * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    turn = np.arange(DIRECTIONS) * np.pi * (3 - 5**0.5)
    across = np.sqrt(1 - up**2)
    return [Vector(way) for way in np.stack([across * np.cos(turn), across * np.sin(turn), up], axis=1).tolist()]


def render_image(scene: bpy.types.Scene) -> np.ndarray:
    """(SIZE, SIZE, 4) float32 of the scene, top row first."""
    with tempfile.TemporaryDirectory() as folder:
        scene.render.filepath = str(Path(folder) / "picture.png")
        bpy.ops.render.render(write_still=True, scene=scene.name)
        image = bpy.data.images.load(scene.render.filepath)
        pixels = np.empty(SIZE * SIZE * 4, np.float32)
        image.pixels.foreach_get(pixels)
        bpy.data.images.remove(image)
    return pixels.reshape(SIZE, SIZE, 4)[::-1]


def save_png(pixels: np.ndarray, path: Path) -> None:
    """Write (H, W, 4) float32, top row first, as a PNG file."""
    height, width = pixels.shape[:2]
    # Gray where there is nothing: neither stripe.
    shown, covered = pixels[..., :3], pixels[..., 3:]
    flat = np.concatenate([shown * covered + BACKGROUND * (1 - covered), np.ones_like(covered)], axis=2)
    image = bpy.data.images.new("worst poses", width, height)
    image.pixels.foreach_set(np.ascontiguousarray(flat[::-1]).ravel())
    image.filepath_raw, image.file_format = str(path.absolute()), "PNG"
    image.save(quality=95)


if __name__ == "__main__":
    fdda_addon.register()
    try:
        main()
    finally:
        fdda_addon.unregister()
