# SPDX-License-Identifier: GPL-3.0-or-later
"""Soak test of frames, undo steps, loads, binds and evaluation paths.

Each compares the shown mesh with the model's output for the same pose.
"""

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

import fdda_addon
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.scene.scene_rig import find_rig
from tests.blender.conftest import ELBOW, ELBOW_RIG, evaluated_positions, pose, predicted_positions
from tests.blender.test_evaluations import (
    FRAMES,
    add_shape_key,
    export_alembic,
    export_usd,
    positions_in_file,
    shown_in,
)
from tests.blender.test_renders import render_positions, set_camera, still

from .cases import CaseFailedError, print_case, run_case

MAX_FILE_ERROR_M = 1e-6
"""Error limit of exported files, whose precision and coordinate systems differ, meters."""


def run_frames(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Go to random frames and subframes."""
    bound, random = open_bound(folder), np.random.default_rng((seed, first_case))

    def set_random_frame() -> float:
        subframe = float(random.random()) if random.random() < 0.3 else 0.0
        bpy.context.scene.frame_set(int(random.integers(1, 31)), subframe=subframe)
        return _model_error_m(bound, folder)

    repeat("frames", first_case, end_case, set_random_frame)


def run_undo(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Change poses and modes with undo steps, and undo and redo them at random."""
    open_bound(folder)
    random = np.random.default_rng((seed, first_case))
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    bpy.ops.ed.undo_push(message="start")

    def change_or_undo() -> float:
        action = random.integers(10)
        if action < 5:
            bone = bpy.data.objects[ELBOW_RIG].pose.bones[str(random.choice(["upper", "lower"]))]
            bone.rotation_euler[0] = float(random.uniform(-1, 1))
            bpy.context.view_layer.update()
            bpy.ops.ed.undo_push(message="pose")
        elif action == 5:
            bpy.data.objects[ELBOW].fdda.mode = str(random.choice(["RIG", "LINEAR", "FDDA"]))
            bpy.context.view_layer.update()
            bpy.ops.ed.undo_push(message="mode")
        elif action < 8:
            bpy.ops.ed.undo() if bpy.ops.ed.undo.poll() else None
        else:
            bpy.ops.ed.redo() if bpy.ops.ed.redo.poll() else None
        bpy.context.view_layer.update()
        mesh_object = bpy.data.objects[ELBOW]
        return _model_error_m(mesh_object, folder) if mesh_object.fdda.mode == "FDDA" else 0.0

    repeat("undo steps", first_case, end_case, change_or_undo)


def run_loads(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Alternately open a bound file, and open a rig, bind its model, unbind it and bind it again."""
    load_index = first_case

    def load() -> float:
        nonlocal load_index
        load_index += 1
        if load_index % 2:
            return _model_error_m(open_bound(folder), folder)
        bpy.ops.wm.open_mainfile(filepath=str(folder / "elbow.blend"))
        rig = find_rig()
        bind(rig, folder / "elbow.onnx")
        bpy.context.scene.frame_set(load_index % 30)
        error_m = _model_error_m(rig.mesh_object, folder)
        unbind(rig.mesh_object)
        bind(find_rig(), folder / "elbow.onnx")
        bpy.context.view_layer.update()
        return max(error_m, _model_error_m(find_rig().mesh_object, folder))

    repeat("loads and binds", first_case, end_case, load)


def run_paths(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Evaluate the mesh in every way that Blender offers; where renders show the rig, compare with the rig."""
    for name, run_path in [*EVALUATION_PATHS.items()][first_case:end_case]:
        print_case(run_case("evaluation paths", name, lambda r=run_path: r(folder)))


def repeat(part: str, first_case: int, end_case: int, action: Callable[[], float]) -> None:
    """Run an action once per case; it returns its largest error, meters."""
    for case_index in range(first_case, end_case):
        print_case(run_case(part, f"{part} {case_index}", action))


def open_bound(folder: Path) -> bpy.types.Object:
    """Open the bound elbow of a folder."""
    bpy.ops.wm.open_mainfile(filepath=str(folder / "bound.blend"))
    fdda_addon.register()
    return bpy.data.objects[ELBOW]


def _model_error_m(mesh_object: bpy.types.Object, folder: Path) -> float:
    """Return the distance between the shown mesh and the model's output, meters; any distance fails the case."""
    if mesh_object.fdda.status:
        raise CaseFailedError(mesh_object.fdda.status)
    return _distance_m(evaluated_positions(mesh_object), predicted_positions(mesh_object, folder / "elbow.onnx"), 0.0)


def _distance_m(shown: np.ndarray, expected: np.ndarray, max_distance_m: float) -> float:
    """Return the largest distance between two arrays of positions, meters; fail the case where it is too large."""
    distance_m = float(np.linalg.norm(shown - expected, axis=1).max())
    if not distance_m <= max_distance_m:
        raise CaseFailedError(f"the mesh is {distance_m} m from the expected positions")
    return distance_m


def _check_frames(folder: Path) -> float:
    bound, error_m = open_bound(folder), 0.0
    for frame in range(1, 31):
        bpy.context.scene.frame_set(frame, subframe=0.5 * (frame % 2))
        error_m = max(error_m, _model_error_m(bound, folder))
    return error_m


def _check_poses(folder: Path) -> float:
    bound, error_m = open_bound(folder), 0.0
    bpy.data.objects[ELBOW_RIG].animation_data_clear()
    for angle in np.linspace(-1, 1, 21):
        pose(angle=float(angle))
        error_m = max(error_m, _model_error_m(bound, folder))
    return error_m


def _check_view_layers_and_scenes(folder: Path) -> float:
    bound, error_m = open_bound(folder), 0.0
    layer, scene = bpy.context.scene.view_layers.new("second"), bpy.data.scenes.new("second")
    for name in (ELBOW, ELBOW_RIG):
        scene.collection.objects.link(bpy.data.objects[name])
    for frame in FRAMES:
        bpy.context.scene.frame_set(frame)
        layer.update()
        expected = predicted_positions(bound, folder / "elbow.onnx")
        scene.frame_set(frame)
        for graph in (layer.depsgraph, scene.view_layers[0].depsgraph):
            error_m = max(error_m, _distance_m(shown_in(graph, bound), expected, 0.0))
    return error_m


def _check_instances(folder: Path) -> float:
    bound, error_m = open_bound(folder), 0.0
    collection = bpy.data.collections.new("character")
    collection.objects.link(bound)
    empty = bpy.data.objects.new("instance", None)
    empty.instance_type, empty.instance_collection, empty.location.x = "COLLECTION", collection, 2
    bpy.context.scene.collection.objects.link(empty)
    for frame in FRAMES:
        bpy.context.scene.frame_set(frame)
        graph = bpy.context.evaluated_depsgraph_get()
        meshes = [i.object.data for i in graph.object_instances if i.is_instance and i.object.original == bound]
        expected = predicted_positions(bound, folder / "elbow.onnx")
        for mesh in meshes:
            error_m = max(error_m, _distance_m(np.array([v.co[:] for v in mesh.vertices], np.float32), expected, 0.0))
        if not meshes:
            raise CaseFailedError("there is no instance")
    return error_m


def _check_linked(folder: Path) -> float:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    fdda_addon.register()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "shot.blend"))
    with bpy.data.libraries.load(str(folder / "bound.blend"), link=True) as (_, linked):
        linked.objects = [ELBOW, ELBOW_RIG]
    for linked_object in linked.objects:
        bpy.context.scene.collection.objects.link(linked_object)
    error_m = 0.0
    for frame in FRAMES:
        bpy.context.scene.frame_set(frame)
        error_m = max(error_m, _model_error_m(linked.objects[0], folder))
    return error_m


def _check_still(engine: str, use_in_render: bool) -> Callable[[Path], float]:
    def check(folder: Path) -> float:
        bound = open_bound(folder)
        set_camera()
        scene = bpy.context.scene
        scene.render.engine = engine
        if engine == "CYCLES":
            scene.cycles.samples, scene.cycles.use_denoising = 2, False
        bound.fdda.use_in_render = use_in_render
        expected = predicted_positions(bound, folder / "elbow.onnx")
        if not use_in_render:
            bound.fdda.mode = "RIG"
            expected = evaluated_positions(bound)
            bound.fdda.mode = "FDDA"
        plain = render_positions(bound, expected, folder / "plain.png")
        if not np.array_equal(still(folder / "still.png"), plain):
            raise CaseFailedError("the picture differs from that of a mesh with the expected positions")
        return 0.0

    return check


def _check_export(
    export: Callable[[Path, str], None], suffix: str, mode: str, use_in_render: bool
) -> Callable[[Path], float]:
    def check(folder: Path) -> float:
        bound = add_shape_key(open_bound(folder))
        bound.fdda.use_in_render = use_in_render
        expected = {}
        for frame in FRAMES:
            bpy.context.scene.frame_set(frame)
            bound.fdda.mode = "FDDA" if mode == "VIEWPORT" or use_in_render else "RIG"
            expected[frame] = evaluated_positions(bound)
            bound.fdda.mode = "FDDA"
        path = folder / f"exported{suffix}"
        export(path, mode)
        return max(
            _distance_m(positions, expected[frame], MAX_FILE_ERROR_M)
            for frame, positions in positions_in_file(path).items()
        )

    return check


_ENGINES = ("BLENDER_WORKBENCH", "CYCLES")
_EXPORTS = {".abc": export_alembic, ".usdc": export_usd}
EVALUATION_PATHS: dict[str, Callable[[Path], float]] = {
    "frames and subframes": _check_frames,
    "poses by hand": _check_poses,
    "view layers and scenes": _check_view_layers_and_scenes,
    "instances of a collection": _check_instances,
    "linked from a library": _check_linked,
    **{
        f"still, {engine}, {'model' if use_in_render else 'rig'} in renders": _check_still(engine, use_in_render)
        for engine in _ENGINES
        for use_in_render in (False, True)
    },
    **{
        f"{suffix} as for {mode}, {'model' if use_in_render else 'rig'} in renders": _check_export(
            export, suffix, mode, use_in_render
        )
        for suffix, export in _EXPORTS.items()
        for mode in ("VIEWPORT", "RENDER")
        for use_in_render in (False, True)
    },
}
"""Ways in which Blender evaluates a mesh, each with a function that returns its largest error, meters."""
