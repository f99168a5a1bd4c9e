# SPDX-License-Identifier: GPL-3.0-or-later
"""Check of the system's temporary folder."""

import tempfile

from .errors import DiskFullError, os_error_text


def check_temporary_folder() -> None:
    """Check that files can be written to the system's temporary folder; imported packages may need one.

    Raises:
        DiskFullError: no file can be written.
    """
    try:
        tempfile.gettempdir()
    except OSError as error:
        raise temporary_folder_error(error) from error


def temporary_folder_error(error: OSError) -> DiskFullError:
    """Return the error for a temporary folder that cannot be written; Python tries several folders."""
    return DiskFullError(
        f"No temporary file can be written ({os_error_text(error)}); make room there, or name another folder in TMPDIR."
    )
