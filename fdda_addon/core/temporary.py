# SPDX-License-Identifier: GPL-3.0-or-later
"""The system's temporary folder, which may take no file."""

import tempfile

from .errors import NoRoomError, os_reason


def check_temporary_folder() -> None:
    """Fail where the system's temporary folder takes no file: packages that are imported may need one.

    Raises:
        NoRoomError: it takes none.
    """
    try:
        tempfile.gettempdir()
    except OSError as error:
        raise temporary_failed(error) from error


def temporary_failed(error: OSError) -> NoRoomError:
    """The error where the system's temporary folder takes no file; Python looks for one that does."""
    return NoRoomError(
        f"No temporary file can be written ({os_reason(error)}); make room there, or name another folder in TMPDIR."
    )
