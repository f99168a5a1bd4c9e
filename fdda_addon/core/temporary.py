# SPDX-License-Identifier: GPL-3.0-or-later
"""The system's temporary folder, which may take no file."""

import tempfile

from .errors import DiskFullError, os_error_text


def check_temporary_folder() -> None:
    """Fail where the system's temporary folder takes no file: packages that are imported may need one.

    Raises:
        DiskFullError: it takes none.
    """
    try:
        tempfile.gettempdir()
    except OSError as error:
        raise temporary_folder_error(error) from error


def temporary_folder_error(error: OSError) -> DiskFullError:
    """The error where the system's temporary folder takes no file; Python looks for one that does."""
    return DiskFullError(
        f"No temporary file can be written ({os_error_text(error)}); make room there, or name another folder in TMPDIR."
    )
