# SPDX-License-Identifier: GPL-3.0-or-later
"""Saves copies of the open .blend file atomically, and turns Blender's reports into error messages."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy

from ..core.errors import FDDAError
from ..core.files.open_files import remove_file
from ..core.files.output import atomic_write, check_writable
from ..core.files.path_limits import path_length_problem

SEEK_TABLE_END = bytes.fromhex("b1ea928f")
"""Last bytes of a compressed .blend file, which is in Zstandard's seekable format."""


def save_copy(path: Path) -> None:
    """Save a copy of the open file atomically; Blender remaps the relative paths in the copy.

    Raises:
        OutputError: the copy cannot be written.
    """
    check_writable(path)
    with atomic_write(path) as temporary_path:
        # Blender keeps a backup of a file that it overwrites.
        remove_file(temporary_path)
        try:
            with silenced_stdout():
                bpy.ops.wm.save_as_mainfile(
                    filepath=blender_path(temporary_path), copy=True, compress=True, check_existing=False
                )
        except RuntimeError as error:
            raise OSError(report_message(error)) from error
        # On a full disk Blender 4.5 saves half of a compressed file and reports success.
        if temporary_path.read_bytes()[-len(SEEK_TABLE_END) :] != SEEK_TABLE_END:
            raise OSError("Blender wrote only a part of it, the disk may be full")


def blender_path(path: Path) -> str:
    """Return an absolute path for Blender, which would truncate a path that is too long.

    Raises:
        FDDAError: the path is too long.
    """
    absolute_path = path.absolute()
    if problem := path_length_problem(absolute_path):
        raise FDDAError(f"Blender cannot open or write '{path}': {problem}; choose a shorter folder.")
    return str(absolute_path)


def report_message(error: RuntimeError) -> str:
    """Return the first report of an operator that failed."""
    return str(error).strip().removeprefix("Error: ").partition("\n")[0]


@contextlib.contextmanager
def silenced_stdout() -> Iterator[None]:
    """Discard Blender's own output ("Read blend: …"), so that stdout contains only the results of a verb."""
    sys.stdout.flush()
    stdout_copy = os.dup(1)
    try:
        with open(os.devnull, "w") as sink:
            os.dup2(sink.fileno(), 1)
            # Blender prints the reports of a failed operator through Python, everything else through C.
            with contextlib.redirect_stdout(sink):
                yield
    finally:
        os.dup2(stdout_copy, 1)
        os.close(stdout_copy)
