# SPDX-License-Identifier: GPL-3.0-or-later
"""`bake RIG.blend MODEL.onnx OUT`: bakes an action, deformed by the model, to a file that plays without the add-on."""

import argparse
from pathlib import Path

from ..baking.run import BakeSettings, bake, output_files
from ..core.sentences.counts import format_count
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
        help="file to write: a .pc2 point cache, or a .blend file (a copy of RIG.blend with a .pc2 file next to it)",
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
        "--shape-keys", action="store_true", help="store the positions in the .blend file, as one shape key per frame"
    )
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    # Check the outputs before a file is opened, which may take long.
    frames = tuple(options.frames) if options.frames else None
    settings = BakeSettings(options.action, frames, options.shape_keys, options.overwrite)
    output_files(options.out, settings, (options.rig, options.model))
    scene_rig = open_rig(options)
    with ProgressPrinter() as progress:
        baked = progress.run(bake(scene_rig, options.model, options.out, settings))
    animation_name = settings.action or "the scene"
    for path in baked.files[1:]:
        print(f"{path}: the positions, to be kept beside {options.out.name}")
    frame_text = format_count(len(baked.frames), "frame")
    print(f"{options.out}: {frame_text} of {animation_name} ({baked.frames[0]} to {baked.frames[-1]})")
