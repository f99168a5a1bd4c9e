# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure time and memory of large characters: `python benchmarks/large_characters.py OUT`, for docs/benchmarks.md.

Records, trains, binds and times two characters: an arm of 200,000 vertices (the densest arm, each face cut into four)
and a creature of 500 bones. Prints seconds and peak memory of every command, and the load of the machine.
"""

import argparse
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.bench import measure, run
from blend_fixtures.characters.meshes import five_hundred_bones
from fdda_addon.arm.rig import build_arm
from fdda_addon.scene.blend_file import save_copy


def build_subdivided_arm() -> None:
    """Build the arm of 50,618 vertices and cut every face into four; Blender interpolates weights and shape keys."""
    mesh_object, _ = build_arm(density=3)
    bpy.context.view_layer.objects.active = mesh_object
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        bpy.ops.mesh.select_all(action="SELECT")
        bpy.ops.mesh.subdivide(number_cuts=1, smoothness=0.0)
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")


CHARACTERS: dict[str, tuple[Callable[[], object], int]] = {
    "arm": (build_subdivided_arm, 300),
    "creature": (five_hundred_bones, 1000),
}
"""By name: the function that builds the character, and the number of poses to record."""


def build(name: str, path: Path) -> None:
    """Build a character in an empty scene and save it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    CHARACTERS[name][0]()
    save_copy(path)


def measure_character(name: str, folder: Path, poses: int) -> None:
    """Record `poses` poses of a character, train, bind and time it; print one line per step."""
    rig, recording, model, bound = (
        folder / f"{name}{suffix}" for suffix in (".blend", "_recording", ".onnx", "_bound.blend")
    )
    build(name, rig)
    shutil.rmtree(recording, ignore_errors=True)
    commands = {
        "record": ("-m", "fdda_addon", "record", rig, recording, "--poses", poses),
        # The verb `train` starts this process; its memory is measured directly.
        "train": ("-m", "trainer", recording, model),
        "bind": ("-m", "fdda_addon", "bind", rig, model, bound),
    }
    for verb, command in commands.items():
        cost = run(*command)
        load = os.getloadavg()[0]
        print(f"{name}: {verb} {cost.seconds:.0f} s, peak memory {cost.peak_mb:,.0f} MB, load {load:.1f}", flush=True)
    frame_times = measure("frames", rig, model)
    print(
        f"{name}: {frame_times['vertices']:,} vertices, {poses} poses; "
        f"a frame {frame_times['rig']['median']:.1f} ms with the rig, "
        f"{frame_times['fdda']['median']:.1f} ms with the model",
        flush=True,
    )


def main() -> None:
    """Measure the characters that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for all output")
    parser.add_argument("--only", choices=CHARACTERS, action="append", help="measure only this character")
    parser.add_argument("--poses", type=int, help="poses to record (default 300 for the arm, 1000 for the creature)")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only or CHARACTERS:
        measure_character(name, options.out, options.poses or CHARACTERS[name][1])


if __name__ == "__main__":
    main()
