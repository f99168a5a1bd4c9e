# SPDX-License-Identifier: GPL-3.0-or-later
"""`bake RIG.blend MODEL.onnx OUT`: bakes an action of the model to a file that plays without the add-on."""

import argparse
from pathlib import Path

from ..baking.run import BakeSettings, bake, output_files
from ..core.progress import Progress
from .files import add_rig_options, open_rig
from .outputs import add_overwrite_option
from .progress import ProgressPrinter


def add_options(parser: argparse.ArgumentParser) -> None:
    add_rig_options(parser)
    parser.add_argument("model", metavar="MODEL.onnx", type=Path, help="the model")
    parser.add_argument(
        "out",
        metavar="OUT",
        type=Path,
        help="a .pc2 file for the positions alone, or a .blend file for a copy of the rig's file that plays them, with "
        "a .pc2 file beside it",
    )
    parser.add_argument("--action", default="", metavar="NAME", help="bake this action (default: what is animated)")
    parser.add_argument(
        "--frames",
        type=int,
        nargs=2,
        metavar=("FIRST", "LAST"),
        help="the frames (default: those of the action, else of the scene)",
    )
    parser.add_argument(
        "--shape-keys", action="store_true", help="keep the positions in the .blend file, a shape key each frame"
    )
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    # Before a file is opened, which may take long.
    frames = tuple(options.frames) if options.frames else None
    settings = BakeSettings(options.action, frames, options.shape_keys, options.overwrite)
    output_files(options.out, settings, (options.rig, options.model))
    scene_rig = open_rig(options)
    with ProgressPrinter() as progress:
        for step in bake(scene_rig, options.model, options.out, settings):
            if isinstance(step, Progress):
                progress.show(step.stage, step.done, step.total)
    what = settings.action or "the scene"
    for path in step.files[1:]:
        print(f"{path}: the positions, to be kept beside {options.out.name}")
    print(f"{options.out}: {len(step.frames)} frames of {what} ({step.frames[0]} to {step.frames[-1]})")
