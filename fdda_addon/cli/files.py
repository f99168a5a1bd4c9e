# SPDX-License-Identifier: GPL-3.0-or-later
"""Opening and saving .blend files, with sentences in place of Blender's reports."""

import argparse
import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy

from ..core.errors import FDDAError
from ..core.output import check_writable, replacing
from ..scene.rig import SceneRig, find_rig


def add_rig_options(parser: argparse.ArgumentParser) -> None:
    """The rig file and its object."""
    parser.add_argument("rig", metavar="RIG.blend", type=Path, help="the file with the rig")
    parser.add_argument("--object", default="", metavar="NAME", help="the mesh object, when several have a rig")


def open_rig(options: argparse.Namespace) -> SceneRig:
    """Open a .blend file and find its rig.

    Raises:
        FDDAError: the file cannot be opened, or holds no rig.
    """
    open_file(options.rig)
    return find_rig(options.object)


def open_file(path: Path) -> None:
    """Open a .blend file.

    Raises:
        FDDAError: there is no such file, or Blender cannot read it.
    """
    if not path.is_file():
        raise FDDAError(f"There is no file '{path}'; give the path of a .blend file.")
    try:
        with quiet():
            bpy.ops.wm.open_mainfile(filepath=str(path.absolute()), load_ui=False)
    except RuntimeError as error:
        reason = str(error).strip().removeprefix("Error: ").partition("\n")[0]
        raise FDDAError(f"Blender cannot open '{path}' ({reason}); give a .blend file.") from error


def save_copy(path: Path) -> None:
    """Save the open file to a path, wholly or not at all; relative paths inside are kept right.

    Raises:
        OutputError: it cannot be written.
    """
    check_writable(path)
    with replacing(path) as temporary, quiet():
        try:
            bpy.ops.wm.save_as_mainfile(
                filepath=str(temporary.absolute()), copy=True, compress=True, check_existing=False
            )
        except RuntimeError as error:
            raise OSError(str(error).strip()) from error


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep Blender's own lines ("Read blend: …") off stdout, where a verb prints its results."""
    sys.stdout.flush()
    saved = os.dup(1)
    try:
        with open(os.devnull, "w") as sink:
            os.dup2(sink.fileno(), 1)
            yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
