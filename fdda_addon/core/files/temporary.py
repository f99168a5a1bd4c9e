# SPDX-License-Identifier: GPL-3.0-or-later
"""The system's temporary folder, which may be full or missing."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from ..errors import DiskFullError, OutputError, os_error_text


def check_temporary_folder() -> None:
    """Check that files can be written to the system's temporary folder; imported packages may need one.

    Raises:
        DiskFullError: no file can be written.
    """
    try:
        tempfile.gettempdir()
    except OSError as error:
        raise _temporary_folder_error(error) from error


def new_temporary_file() -> TextIO:
    """Create a text file without a name, which is removed when it is closed.

    Raises:
        DiskFullError: it cannot be created.
    """
    try:
        return tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")
    except OSError as error:
        raise _temporary_folder_error(error) from error


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Create a folder in the system's temporary folder, yield it, and remove it afterwards.

    Raises:
        DiskFullError: the folder cannot be created, or the block cannot write a file in it.
    """
    try:
        # On Windows a virus scanner may have a file open when the folder is removed.
        folder = tempfile.TemporaryDirectory(prefix="fdda-", ignore_cleanup_errors=True)
    except OSError as error:
        raise _temporary_folder_error(error) from error
    with folder as name:
        try:
            yield Path(name)
        except DiskFullError:
            raise
        except OutputError as error:
            # Errors of Blender have no error number that tells a full disk.
            if name not in str(error):
                raise
            raise _temporary_folder_error(error.__cause__ or error) from error
        except OSError as error:
            if error.filename is not None and name not in str(error.filename):
                raise
            raise _temporary_folder_error(error) from error


def _temporary_folder_error(error: BaseException) -> DiskFullError:
    """Return the error for a temporary folder that cannot be written; Python tries several folders."""
    reason = os_error_text(error) if isinstance(error, OSError) else str(error)
    return DiskFullError(
        f"No temporary file can be written ({reason}); make room there, or name another folder in TMPDIR."
    )
