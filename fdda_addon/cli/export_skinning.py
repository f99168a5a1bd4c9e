# SPDX-License-Identifier: GPL-3.0-or-later
"""`export-skinning RIG.blend RECORDING OUT.blend`: saves a copy whose meshes follow fitted skin weights alone."""

import argparse
from pathlib import Path

from ..baking.skinning import export_skinning
from ..core.errors import WrongUsageError
from ..core.files.file_kind import BLEND
from ..core.files.output import check_outputs
from ..core.recording.index import read_index
from ..recording.plan import find_recorded_character
from ..scene.blend_file import save_copy
from .files import add_overwrite_option, add_repeatable_option, add_rig_options, open_file
from .progress import ProgressPrinter

MAX_INFLUENCES = 16
"""Largest number of weights per vertex; the fit has as many candidates."""


def add_options(parser: argparse.ArgumentParser) -> None:
    add_rig_options(parser)
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="recording of the meshes to export")
    parser.add_argument("out", metavar="OUT.blend", type=Path, help="file to save, ready for glTF and FBX")
    parser.add_argument(
        "--influences", type=int, default=4, metavar="N", help="largest number of bones per vertex (default 4)"
    )
    text = "recorded action to which nothing is fitted, to measure errors on it"
    add_repeatable_option(parser, "--hold-out", "ACTION", text)
    parser.add_argument("--model", metavar="MODEL.onnx", type=Path, help="model whose errors are measured, too")
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    if not 1 <= options.influences <= MAX_INFLUENCES:
        raise WrongUsageError(f"--influences must be 1 to {MAX_INFLUENCES}.")
    check_outputs({options.out: BLEND}, (options.rig,), options.overwrite)
    open_file(options.rig)
    object_name = options.object or read_index(options.recording)["meshes"][0]["name"]
    scene_rig = find_recorded_character(options.recording, object_name)
    with ProgressPrinter() as progress:
        skins = progress.run(
            export_skinning(scene_rig, options.recording, options.influences, tuple(options.hold_out), options.model)
        )
    save_copy(options.out)
    for skin in skins:
        print(f"{options.out}: {skin.table()}")
