# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure frames per second in a window: `blender BOUND.blend --python benchmarks/viewport.py -- OUT.json [FRAMES]`.

Plays the frames of the scene alternately with the rig and with the model, for all bound characters at once, with the
sidebar closed. Times each frame twice: first evaluated and drawn, as during playback, then only drawn again. Writes the
medians to OUT.json, prints them, and quits Blender.
"""

import json
import statistics
import sys
import time
from pathlib import Path

import bpy

ROUNDS = 3
"""How often rig and model alternate."""
WARM_UP_FRAMES = 5
SETTLE_SECONDS = 2.0
"""Time from the start until the drawing time of the window is steady, seconds."""
MODES = ("RIG", "FDDA")


def bound_characters() -> list[bpy.types.Object]:
    """Return the bound mesh objects of the file."""
    return [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound]


def time_redraw_ms(kind: str) -> float:
    """Time one iteration of Blender's operator `wm.redraw_timer`, in milliseconds."""
    start = time.perf_counter()
    bpy.ops.wm.redraw_timer(type=kind, iterations=1)
    return (time.perf_counter() - start) * 1000


def measure(frames: int) -> dict[str, dict[str, float]]:
    """Return, by mode, the median milliseconds to play a frame and to draw it again, and the frames per second."""
    scene = bpy.context.scene
    frame_ms: dict[str, list[float]] = {mode: [] for mode in MODES}
    drawing_ms: dict[str, list[float]] = {mode: [] for mode in MODES}
    for _ in range(ROUNDS):
        for mode in MODES:
            for mesh_object in bound_characters():
                mesh_object.fdda.mode = mode
            scene.frame_set(scene.frame_start)
            for frame_index in range(WARM_UP_FRAMES + frames):
                played_ms = time_redraw_ms("ANIM_STEP") + time_redraw_ms("DRAW_WIN_SWAP")
                redrawn_ms = time_redraw_ms("DRAW_WIN_SWAP")
                if frame_index >= WARM_UP_FRAMES:
                    frame_ms[mode].append(played_ms)
                    drawing_ms[mode].append(redrawn_ms)
    return {
        mode: {
            "frame": statistics.median(frame_ms[mode]),
            "drawing": statistics.median(drawing_ms[mode]),
            "frames_per_second": 1000 / statistics.median(frame_ms[mode]),
        }
        for mode in MODES
    }


def main(out: Path, frames: int) -> None:
    """Measure both modes, write the medians to a file and print them."""
    for area in bpy.context.screen.areas:
        if area.type == "VIEW_3D":
            area.spaces.active.show_region_ui = False
    results = {
        "unit": "ms",
        "blender": bpy.app.version_string,
        "characters": {o.name: len(o.data.vertices) for o in bound_characters()},
        "modes": measure(frames),
    }
    out.write_text(json.dumps(results, indent=1))
    for mode, values in results["modes"].items():
        print(f"{mode}: {', '.join(f'{name} {value:.2f}' for name, value in values.items())}", flush=True)
    if not results["characters"]:
        print("No bound character in this file; bind one first.", file=sys.stderr)


def _begin() -> None:
    arguments = sys.argv[sys.argv.index("--") + 1 :]
    try:
        with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
            main(Path(arguments[0]), int(arguments[1]) if len(arguments) > 1 else 100)
    finally:
        bpy.ops.wm.quit_blender()


if __name__ == "__main__":
    bpy.context.preferences.view.show_splash = False
    bpy.app.timers.register(_begin, first_interval=SETTLE_SECONDS)
