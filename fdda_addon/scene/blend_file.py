# SPDX-License-Identifier: GPL-3.0-or-later
"""Saving the open .blend file elsewhere, wholly or not at all, with sentences in place of Blender's reports."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy

from ..core.errors import FDDAError
from ..core.open_files import remove_file
from ..core.output import atomic_write, check_writable
from ..core.path_limits import path_length_problem

SEEK_TABLE_END = bytes.fromhex("b1ea928f")
"""Last bytes of a compressed .blend file, which is one of Zstandard's seekable format."""


def save_copy(path: Path) -> None:
    """Save the open file to a path, wholly or not at all; relative paths inside are kept right.

    Raises:
        OutputError: it cannot be written.
    """
    check_writable(path)
    with atomic_write(path) as temporary:
        # Blender keeps a second copy of a file that it saves over.
        remove_file(temporary)
        try:
            with silenced_stdout():
                bpy.ops.wm.save_as_mainfile(
                    filepath=blender_path(temporary), copy=True, compress=True, check_existing=False
                )
        except RuntimeError as error:
            raise OSError(report_message(error)) from error
        # Blender 4.5 saves half a compressed file to a full disk and calls it finished.
        if temporary.read_bytes()[-len(SEEK_TABLE_END) :] != SEEK_TABLE_END:
            raise OSError("Blender wrote only a part of it, the disk may be full")


def blender_path(path: Path) -> str:
    """A path as it is handed to Blender, which cuts one that is too long, and reads or writes another file then.

    Raises:
        FDDAError: it is too long.
    """
    absolute = path.absolute()
    if limit := path_length_problem(absolute):
        raise FDDAError(f"Blender cannot open or write '{path}': {limit}; choose a shorter folder.")
    return str(absolute)


def report_message(error: RuntimeError) -> str:
    """The first of the reports that an operator failed with."""
    return str(error).strip().removeprefix("Error: ").partition("\n")[0]


@contextlib.contextmanager
def silenced_stdout() -> Iterator[None]:
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
