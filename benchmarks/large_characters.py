# SPDX-License-Identifier: GPL-3.0-or-later
"""What large characters take: `python benchmarks/large_characters.py OUT`, for docs/benchmarks.md.

An arm of 200,000 vertices (the densest, each face cut into four) and a creature of 500 bones: each is recorded,
trained, bound and timed. Prints seconds and peak memory of every command, and the load of the machine beside them.
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


def subdivided_arm() -> None:
    """The arm of 50,618 vertices with every face cut into four; weights and shape keys are interpolated."""
    mesh_object, _ = build_arm(density=3)
    bpy.context.view_layer.objects.active = mesh_object
    bpy.ops.object.mode_set(mode="EDIT")
    try:
        bpy.ops.mesh.select_all(action="SELECT")
        bpy.ops.mesh.subdivide(number_cuts=1, smoothness=0.0)
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")


CHARACTERS: dict[str, tuple[Callable[[], object], int]] = {
    "arm": (subdivided_arm, 300),
    "creature": (five_hundred_bones, 1000),
}
"""How each is built, and how many poses of it are recorded."""


def build(name: str, path: Path) -> None:
    """Build a character into a file of its own."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    CHARACTERS[name][0]()
    save_copy(path)


def measure_character(name: str, folder: Path, poses: int) -> None:
    """Record so many poses of a character, train, bind and time it; prints a line for each."""
    rig, recording, model, bound = (
        folder / f"{name}{end}" for end in (".blend", "_recording", ".onnx", "_bound.blend")
    )
    build(name, rig)
    shutil.rmtree(recording, ignore_errors=True)
    commands = {
        "record": ("-m", "fdda_addon", "record", rig, recording, "--poses", poses),
        # The process that learns: what `train` starts.
        "train": ("-m", "trainer", recording, model),
        "bind": ("-m", "fdda_addon", "bind", rig, model, bound),
    }
    for verb, command in commands.items():
        cost = run(*command)
        load = os.getloadavg()[0]
        print(f"{name}: {verb} {cost.seconds:.0f} s, {cost.peak_mb:,.0f} MB at most, load {load:.1f}", flush=True)
    frame = measure("frames", rig, model)
    print(
        f"{name}: {frame['vertices']:,} vertices, {poses} poses; a frame {frame['rig']['median']:.1f} ms with the rig, "
        f"{frame['fdda']['median']:.1f} ms with the model",
        flush=True,
    )


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for all that is made")
    parser.add_argument("--only", choices=CHARACTERS, action="append", help="measure this one alone")
    parser.add_argument("--poses", type=int, help="of each (default 300 of the arm, 1000 of the creature)")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only or CHARACTERS:
        measure_character(name, options.out, options.poses or CHARACTERS[name][1])


if __name__ == "__main__":
    main()
