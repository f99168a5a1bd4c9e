# SPDX-License-Identifier: GPL-3.0-or-later
"""Options that verbs share, and opening of .blend files with FDDAErrors in place of Blender's reports."""

import argparse
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import FDDAError
from ..scene.blend_file import blender_path, report_message, silenced_stdout
from ..scene.scene_rig import SceneRig, find_rig


def add_rig_options(parser: argparse.ArgumentParser) -> None:
    """Add the argument RIG.blend and the option --object."""
    add_rig_argument(parser)
    parser.add_argument("--object", default="", metavar="NAME", help="mesh object to use, if several have a rig")


def add_rig_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument RIG.blend."""
    parser.add_argument("rig", metavar="RIG.blend", type=Path, help="the file with the rig")


def add_model_argument(parser: argparse.ArgumentParser) -> None:
    """Add the argument MODEL.onnx."""
    parser.add_argument("model", metavar="MODEL.onnx", type=Path, help="the model, or a folder of models")


def add_repeatable_option(
    parser: argparse.ArgumentParser, name: str, metavar: str, text: str, **arguments: Any
) -> None:
    """Add an option that may be given several times, with its help and further arguments of `add_argument`."""
    parser.add_argument(
        name, action="append", metavar=metavar, help=f"{text}; repeatable", **{"default": [], **arguments}
    )


def add_overwrite_option(parser: argparse.ArgumentParser) -> None:
    """Add the option --overwrite, for outputs that `core.files.output.check_outputs` refuses to overwrite."""
    parser.add_argument(
        "--overwrite", action="store_true", help="allow overwriting of input files and of files of another kind"
    )


def open_rig(options: argparse.Namespace) -> SceneRig:
    """Open the .blend file of the options, and return its rig."""
    open_file(options.rig)
    return find_rig(options.object)


def check_file(path: Path) -> None:
    """Raise an FDDAError if there is no file to open."""
    if not path.is_file():
        raise FDDAError(f"There is no file '{path}'; give the path of a .blend file.")


def open_file(path: Path) -> None:
    """Open a .blend file.

    Raises:
        FDDAError: there is no such file, or Blender cannot read it.
    """
    check_file(path)
    try:
        with silenced_stdout():
            bpy.ops.wm.open_mainfile(filepath=blender_path(path), load_ui=False)
    except RuntimeError as error:
        raise FDDAError(f"Blender cannot open '{path}' ({report_message(error)}); give a .blend file.") from error
