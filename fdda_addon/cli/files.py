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

SEEK_TABLE_END = bytes.fromhex("b1ea928f")
"""Last bytes of a compressed .blend file, which is one of Zstandard's seekable format."""


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
        raise FDDAError(f"Blender cannot open '{path}' ({_reason(error)}); give a .blend file.") from error


def save_copy(path: Path) -> None:
    """Save the open file to a path, wholly or not at all; relative paths inside are kept right.

    Raises:
        OutputError: it cannot be written.
    """
    check_writable(path)
    with replacing(path) as temporary:
        try:
            with quiet():
                bpy.ops.wm.save_as_mainfile(
                    filepath=str(temporary.absolute()), copy=True, compress=True, check_existing=False
                )
        except RuntimeError as error:
            raise OSError(_reason(error)) from error
        # Blender 4.5 saves half a compressed file to a full disk and calls it finished.
        if temporary.read_bytes()[-len(SEEK_TABLE_END) :] != SEEK_TABLE_END:
            raise OSError("Blender wrote only a part of it, the disk may be full")


def _reason(error: RuntimeError) -> str:
    """The first of the reports that an operator failed with."""
    return str(error).strip().removeprefix("Error: ").partition("\n")[0]


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep Blender's own lines ("Read blend: …") off stdout, where a verb prints its results."""
    sys.stdout.flush()
    saved = os.dup(1)
    try:
        with open(os.devnull, "w") as sink:
            os.dup2(sink.fileno(), 1)
            # Blender prints the reports of a failed operator through Python, all else through C.
            with contextlib.redirect_stdout(sink):
                yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
