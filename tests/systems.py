# SPDX-License-Identifier: GPL-3.0-or-later
"""What only some operating systems have: marks that skip a test elsewhere and give the reason."""

import errno
import os
import sys

import pytest


def _missing_drive() -> str:
    return next(f"{letter}:\\" for letter in "QRSTUVWXY" if not os.path.exists(f"{letter}:\\"))


WINDOWS = sys.platform == "win32"
KILLED = 1 if WINDOWS else -9
"""What `subprocess` says of a process after its method `kill`."""
UNWRITABLE = f"{_missing_drive()}fdda" if WINDOWS else "/proc/fdda"
"""A path at which nothing can be made, not even by an administrator."""
NO_FILE_SIZE_LIMITS = "Windows does not limit the size of a process's files."

NOT_FOUND = os.strerror(errno.ENOENT)
"""What a sentence says of a file that does not exist."""
BELOW_A_FILE = os.strerror(errno.ENOENT if WINDOWS else errno.ENOTDIR)
"""What it says of a path that leads through a file."""

symbolic_links = pytest.mark.skipif(WINDOWS, reason="Windows lets only administrators make symbolic links.")
named_pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes in folders.")
devices = pytest.mark.skipif(WINDOWS, reason="Windows has no devices in folders.")
forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows does not fork processes.")
file_size_limits = pytest.mark.skipif(WINDOWS, reason=NO_FILE_SIZE_LIMITS)
sparse_files = pytest.mark.skipif(WINDOWS, reason="Python on Windows writes every zero of a hollow file to the disk.")
drives = pytest.mark.skipif(not WINDOWS, reason="Only Windows has drives in paths.")
