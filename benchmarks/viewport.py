# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames a second in a window: `blender BOUND.blend --python benchmarks/viewport.py -- OUT.json [FRAMES]`.

Plays the scene's frames with the rig and with the model in turn, all bound characters of the file at once, with the
sidebar closed. A frame is timed twice: evaluated and drawn, as an animator sees it, and drawn alone. Writes the medians
to OUT.json, prints them, and ends Blender.
"""

import json
import statistics
import sys
import time
from pathlib import Path

import bpy

ROUNDS = 3
"""How often rig and model take turns."""
WARM_UP = 5
SETTLE_SECONDS = 2.0
"""A window needs this before what it draws is what it will draw."""
MODES = ("RIG", "FDDA")


def characters() -> list[bpy.types.Object]:
    """The bound mesh objects of the file."""
    return [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound]


def draw_ms(kind: str) -> float:
    """What Blender's own timer of redraws says of one, in milliseconds."""
    start = time.perf_counter()
    bpy.ops.wm.redraw_timer(type=kind, iterations=1)
    return (time.perf_counter() - start) * 1000


def measure(frames: int) -> dict[str, dict[str, float]]:
    """Medians in milliseconds, by mode: a frame played, one drawn again as it stands, and the difference."""
    scene = bpy.context.scene
    played: dict[str, list[float]] = {mode: [] for mode in MODES}
    still: dict[str, list[float]] = {mode: [] for mode in MODES}
    for _ in range(ROUNDS):
        for mode in MODES:
            for mesh_object in characters():
                mesh_object.fdda.mode = mode
            scene.frame_set(scene.frame_start)
            for number in range(WARM_UP + frames):
                step = draw_ms("ANIM_STEP") + draw_ms("DRAW_WIN_SWAP")
                again = draw_ms("DRAW_WIN_SWAP")
                if number >= WARM_UP:
                    played[mode].append(step)
                    still[mode].append(again)
    return {
        mode: {
            "frame": statistics.median(played[mode]),
            "drawing": statistics.median(still[mode]),
            "frames_per_second": 1000 / statistics.median(played[mode]),
        }
        for mode in MODES
    }


def main(out: Path, frames: int) -> None:
    """Measure, write and print."""
    for area in bpy.context.screen.areas:
        if area.type == "VIEW_3D":
            area.spaces.active.show_region_ui = False
    results = {
        "unit": "ms",
        "blender": bpy.app.version_string,
        "characters": {o.name: len(o.data.vertices) for o in characters()},
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
