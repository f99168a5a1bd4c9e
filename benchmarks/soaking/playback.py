# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames, undo steps, loads and binds, and every way to evaluate, against what the model says of the same pose."""

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

import fdda_addon
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.scene.scene_rig import find_rig
from tests.blender.conftest import ELBOW, ELBOW_RIG, evaluated, pose, predicted
from tests.blender.test_evaluations import FRAMES, export_alembic, export_usd, keyed, read_back, shown_in
from tests.blender.test_renders import render_positions, set_camera, still

from .cases import ShortfallError, attempt, say

EXACT = 0.0
NEAR = 1e-6
"""Metres: what a file's own precision, or a space in between, may take."""


def run_frames(folder: Path, seed: int, first: int, end: int) -> None:
    """Frames and subframes at random."""
    bound, random = open_bound(folder), np.random.default_rng((seed, first))

    def frame() -> float:
        subframe = float(random.random()) if random.random() < 0.3 else 0.0
        bpy.context.scene.frame_set(int(random.integers(1, 31)), subframe=subframe)
        return _off(bound, folder)

    repeat("frames", first, end, frame)


def run_undo(folder: Path, seed: int, first: int, end: int) -> None:
    """Poses, modes and copies, each with an undo step; undone and done again at random."""
    open_bound(folder)
    random = np.random.default_rng((seed, first))
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    bpy.ops.ed.undo_push(message="start")

    def step() -> float:
        kind = random.integers(10)
        if kind < 5:
            bone = bpy.data.objects[ELBOW_RIG].pose.bones[str(random.choice(["upper", "lower"]))]
            bone.rotation_euler[0] = float(random.uniform(-1, 1))
            bpy.context.view_layer.update()
            bpy.ops.ed.undo_push(message="pose")
        elif kind == 5:
            bpy.data.objects[ELBOW].fdda.mode = str(random.choice(["RIG", "LINEAR", "FDDA"]))
            bpy.context.view_layer.update()
            bpy.ops.ed.undo_push(message="mode")
        elif kind < 8:
            bpy.ops.ed.undo() if bpy.ops.ed.undo.poll() else None
        else:
            bpy.ops.ed.redo() if bpy.ops.ed.redo.poll() else None
        bpy.context.view_layer.update()
        mesh_object = bpy.data.objects[ELBOW]
        return _off(mesh_object, folder) if mesh_object.fdda.mode == "FDDA" else 0.0

    repeat("undo steps", first, end, step)


def run_loads(folder: Path, seed: int, first: int, end: int) -> None:
    """A file opened, its model bound, played, unbound and bound again; and a bound file opened, in turn."""
    turn = [first]

    def load() -> float:
        turn[0] += 1
        if turn[0] % 2:
            return max(_off(open_bound(folder), folder), 0.0)
        bpy.ops.wm.open_mainfile(filepath=str(folder / "elbow.blend"))
        rig = find_rig()
        bind(rig, folder / "elbow.onnx")
        bpy.context.scene.frame_set(turn[0] % 30)
        off = _off(rig.mesh_object, folder)
        unbind(rig.mesh_object)
        bind(find_rig(), folder / "elbow.onnx")
        bpy.context.view_layer.update()
        return max(off, _off(find_rig().mesh_object, folder))

    repeat("loads and binds", first, end, load)


def run_paths(folder: Path, seed: int, first: int, end: int) -> None:
    """Each way to evaluate; where renders show the rig, what it shows is compared with the rig."""
    ways = [*_WAYS.items()]
    for number in range(first, min(end, len(ways))):
        name, way = ways[number]
        say(attempt("evaluation paths", name, lambda w=way: w(folder)))


def repeat(part: str, first: int, end: int, action: Callable[[], float]) -> None:
    """Do something again and again, a case each; it returns how far it was off."""
    for number in range(first, end):
        say(attempt(part, f"{part} {number}", action))


def open_bound(folder: Path) -> bpy.types.Object:
    """Open the bound elbow of a folder."""
    bpy.ops.wm.open_mainfile(filepath=str(folder / "bound.blend"))
    fdda_addon.register()
    return bpy.data.objects[ELBOW]


def _off(mesh_object: bpy.types.Object, folder: Path, limit: float = EXACT) -> float:
    """How far what the window shows is from what the model says."""
    if mesh_object.fdda.status:
        raise ShortfallError(mesh_object.fdda.status)
    return _apart(evaluated(mesh_object), predicted(mesh_object, folder / "elbow.onnx"), limit)


def _apart(shown: np.ndarray, expected: np.ndarray, limit: float = NEAR) -> float:
    off = float(np.linalg.norm(shown - expected, axis=1).max())
    if not off <= limit:
        raise ShortfallError(f"it is {off} m off")
    return off


def _frames(folder: Path) -> float:
    bound, off = open_bound(folder), 0.0
    for number in range(1, 31):
        bpy.context.scene.frame_set(number, subframe=0.5 * (number % 2))
        off = max(off, _off(bound, folder))
    return off


def _by_hand(folder: Path) -> float:
    bound, off = open_bound(folder), 0.0
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    for angle in np.linspace(-1, 1, 21):
        pose(angle=float(angle))
        off = max(off, _off(bound, folder))
    return off


def _view_layers_and_scenes(folder: Path) -> float:
    bound, off = open_bound(folder), 0.0
    layer, scene = bpy.context.scene.view_layers.new("second"), bpy.data.scenes.new("second")
    for name in (ELBOW, ELBOW_RIG):
        scene.collection.objects.link(bpy.data.objects[name])
    for number in FRAMES:
        bpy.context.scene.frame_set(number)
        layer.update()
        expected = predicted(bound, folder / "elbow.onnx")
        scene.frame_set(number)
        for graph in (layer.depsgraph, scene.view_layers[0].depsgraph):
            off = max(off, _apart(shown_in(graph, bound), expected, EXACT))
    return off


def _instances(folder: Path) -> float:
    bound, off = open_bound(folder), 0.0
    collection = bpy.data.collections.new("character")
    collection.objects.link(bound)
    empty = bpy.data.objects.new("instance", None)
    empty.instance_type, empty.instance_collection, empty.location.x = "COLLECTION", collection, 2
    bpy.context.scene.collection.objects.link(empty)
    for number in FRAMES:
        bpy.context.scene.frame_set(number)
        graph = bpy.context.evaluated_depsgraph_get()
        found = [i.object.data for i in graph.object_instances if i.is_instance and i.object.original == bound]
        expected = predicted(bound, folder / "elbow.onnx")
        for mesh in found:
            off = max(off, _apart(np.array([v.co[:] for v in mesh.vertices], np.float32), expected, EXACT))
        if not found:
            raise ShortfallError("there is no instance")
    return off


def _linked(folder: Path) -> float:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    fdda_addon.register()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
    with bpy.data.libraries.load(str(folder / "bound.blend"), link=True) as (_, wanted):
        wanted.objects = [ELBOW, ELBOW_RIG]
    for linked in wanted.objects:
        bpy.context.scene.collection.objects.link(linked)
    off = 0.0
    for number in FRAMES:
        bpy.context.scene.frame_set(number)
        off = max(off, _off(wanted.objects[0], folder))
    return off


def _still(engine: str, use_in_render: bool) -> Callable[[Path], float]:
    def way(folder: Path) -> float:
        bound = open_bound(folder)
        set_camera()
        scene = bpy.context.scene
        scene.render.engine = engine
        if engine == "CYCLES":
            scene.cycles.samples, scene.cycles.use_denoising = 2, False
        bound.fdda.use_in_render = use_in_render
        expected = predicted(bound, folder / "elbow.onnx")
        if not use_in_render:
            bound.fdda.mode = "RIG"
            expected = evaluated(bound)
            bound.fdda.mode = "FDDA"
        plain = render_positions(bound, expected, folder / "plain.png")
        if not np.array_equal(still(folder / "still.png"), plain):
            raise ShortfallError("the picture is not that of a plain mesh")
        return 0.0

    return way


def _export(
    export: Callable[[Path, str], None], suffix: str, mode: str, use_in_render: bool
) -> Callable[[Path], float]:
    def way(folder: Path) -> float:
        bound = keyed(open_bound(folder))
        bound.fdda.use_in_render = use_in_render
        expected = {}
        for number in FRAMES:
            bpy.context.scene.frame_set(number)
            bound.fdda.mode = "FDDA" if mode == "VIEWPORT" or use_in_render else "RIG"
            expected[number] = evaluated(bound)
            bound.fdda.mode = "FDDA"
        path = folder / f"exported{suffix}"
        export(path, mode)
        return max(_apart(positions, expected[number]) for number, positions in read_back(path).items())

    return way


_ENGINES = ("BLENDER_WORKBENCH", "CYCLES")
_EXPORTS = {".abc": export_alembic, ".usdc": export_usd}
_WAYS: dict[str, Callable[[Path], float]] = {
    "frames and subframes": _frames,
    "poses by hand": _by_hand,
    "view layers and scenes": _view_layers_and_scenes,
    "instances of a collection": _instances,
    "linked from a library": _linked,
    **{
        f"still, {engine}, {'model' if use else 'rig'} in renders": _still(engine, use)
        for engine in _ENGINES
        for use in (False, True)
    },
    **{
        f"{suffix} as for {mode}, {'model' if use else 'rig'} in renders": _export(export, suffix, mode, use)
        for suffix, export in _EXPORTS.items()
        for mode in ("VIEWPORT", "RENDER")
        for use in (False, True)
    },
}
PATHS = len(_WAYS)
