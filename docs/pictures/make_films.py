# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the films of the arm from the files of `make demo`: `make films`.

`arm.mp4` shows the rig beside the model, `arm_error.mp4` the errors of linear skinning and of the model as heat maps.
`make_pictures.py` uses `evaluate_demo` for the animated picture.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import bpy

from benchmarks.demo import VIEW
from fdda_addon import register, unregister
from fdda_addon.arm.joints import ACTION_NAME
from fdda_addon.cli.files import open_file
from fdda_addon.cli.progress import ProgressPrinter
from fdda_addon.core.settings import FILM_TIMED_FRAMES
from fdda_addon.evaluation.film import FDDA, FDDA_ERROR, LINEAR, LINEAR_ERROR, RIG, FilmSettings, film
from fdda_addon.evaluation.results import PoseErrors
from fdda_addon.evaluation.run import evaluate_action
from fdda_addon.scene.scene_rig import SceneRig, find_rig
from fdda_addon.timing.benchmark import benchmark

FILMS = {"arm.mp4": (RIG, FDDA), "arm_error.mp4": (LINEAR_ERROR, FDDA_ERROR)}
"""Columns of each film."""
WIDTH, TEXT_SCALE = 1280, 1.6


def evaluate_demo(folder: Path) -> tuple[SceneRig, Path, PoseErrors, dict[str, float]]:
    """Open the arm of the demo, and return its rig, model, the errors in its action, and the frame times by column."""
    open_file(folder / "arm.blend")
    scene_rig, model = find_rig(), folder / "arm.onnx"
    with ProgressPrinter() as progress:
        times = progress.run(benchmark(scene_rig, model, FILM_TIMED_FRAMES)).frame_times("")
        errors = progress.run(evaluate_action(scene_rig, model, ACTION_NAME)).held_out
    return scene_rig, model, errors, {RIG: times.rig, LINEAR: times.linear, FDDA: times.fdda}


def main(demo_folder: Path, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    scene_rig, model, errors, times = evaluate_demo(demo_folder)
    fps = bpy.context.scene.render.fps
    for name, columns in FILMS.items():
        settings = FilmSettings(columns, VIEW, fps, times, width=WIDTH, text_scale=TEXT_SCALE)
        with ProgressPrinter() as progress:
            result = progress.run(film(scene_rig, model, errors, 1, folder / name, settings))
        print(f"{folder / name}: {result.frames} frames, {result.size[0]} x {result.size[1]} pixels")


if __name__ == "__main__":
    register()
    try:
        main(*map(Path, sys.argv[1:]))
    finally:
        unregister()
