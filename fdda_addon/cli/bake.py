# SPDX-License-Identifier: GPL-3.0-or-later
"""`bake RIG.blend MODEL.onnx OUT`: bakes the meshes as models deform them to a file that plays without the add-on."""

import argparse
from pathlib import Path

from ..baking.export import write_bake
from ..baking.run import BakeSettings, bake_file
from ..core.files.stop_signals import exit_on_stop_signal
from ..core.wording import format_count
from .files import add_model_argument, add_overwrite_option, add_rig_options, open_rigs
from .progress import ProgressPrinter


def add_options(parser: argparse.ArgumentParser) -> None:
    add_rig_options(parser)
    add_model_argument(parser)
    parser.add_argument(
        "out",
        metavar="OUT",
        type=Path,
        help="file to write: Alembic (.abc), USD (.usd, .usdc, .usda), or a .blend file (a copy of RIG.blend with an "
        ".abc file next to it)",
    )
    parser.add_argument(
        "--action", default="", metavar="NAME", help="action to bake (default: the animation of the scene)"
    )
    parser.add_argument(
        "--frames",
        type=int,
        nargs=2,
        metavar=("FIRST", "LAST"),
        help="frames to bake (default: the frames of the action, or else of the scene)",
    )
    parser.add_argument(
        "--samples", type=int, default=1, help="samples per frame, for motion blur of an .abc file (default 1)"
    )
    add_overwrite_option(parser)
    # For the other Blender that exports.
    parser.add_argument("--linear", action="append", default=[], help=argparse.SUPPRESS)
    parser.add_argument("--write-to", type=Path, nargs="+", help=argparse.SUPPRESS)


def run(options: argparse.Namespace) -> None:
    frames = tuple(options.frames) if options.frames else None
    settings = BakeSettings(options.action, frames, options.samples, options.overwrite, tuple(options.linear))
    with ProgressPrinter() as progress:
        if not options.write_to:
            print(progress.run(bake_file(options.rig, options.model, options.out, settings, options.object)), end="")
            return
        # The process that started this one removes the files.
        exit_on_stop_signal()
        rigs_and_models = list(open_rigs(options).values())
        baked_frames = write_bake(
            rigs_and_models,
            options.out,
            options.write_to,
            settings,
            lambda done, total: progress.show("frames", done, total),
        )
    if len(options.write_to) > 1:
        print(f"{options.out.with_suffix('.abc')}: the positions, to be kept beside {options.out.name}")
    names = ", ".join(f"'{scene_rig.mesh_object.name}'" for scene_rig, _ in rigs_and_models)
    frame_text = format_count(len(baked_frames), "frame")
    print(
        f"{options.out}: {names} in {frame_text} of {settings.action or 'the scene'} ({baked_frames[0]} to "
        f"{baked_frames[-1]})"
    )
