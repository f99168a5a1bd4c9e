# SPDX-License-Identifier: GPL-3.0-or-later
"""Opening of untrusted files: regular files only, as pipes may block, devices never end and links lead elsewhere."""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from .open_files import open_with_retry

NOT_A_REGULAR_FILE = "it is not a regular file"
IS_A_LINK = "it is a link to another place"
# A pipe that replaces the file between check and open must not block. Windows has neither these flags nor such pipes.
_NONBLOCK = getattr(os, "O_NONBLOCK", 0)
_NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)


def open_input(path: Path, mode: str = "rb", follow: bool = True) -> BinaryIO:
    """Open a regular file.

    Args:
        path: the file.
        mode: as for `open`; "x+b" creates a file that must not exist.
        follow: whether the path may be a symbolic link; pass False inside of folders that come from elsewhere.

    Raises:
        OSError: it cannot be opened, or is a pipe, a device, a folder or, unless `follow`, a link; see `strerror`.
    """
    return open_with_retry(lambda: _open(path, mode, follow))


def _open(path: Path, mode: str, follow: bool) -> BinaryIO:
    if "x" not in mode:
        _check(os.stat(path, follow_symlinks=follow), path)
    flags = _NONBLOCK | (0 if follow else _NO_FOLLOW)
    file = open(path, mode, opener=lambda name, own: os.open(name, own | flags))  # noqa: SIM115 - the caller closes it
    try:
        _check(os.fstat(file.fileno()), path)
    except OSError:
        file.close()
        raise
    return file


def read_input(path: Path, max_bytes: int, follow: bool = True) -> bytes:
    """Read the bytes of a regular file, as `open_input` opens it.

    Raises:
        OSError: as `open_input`, or it has more than `max_bytes` bytes.
    """
    with open_input(path, follow=follow) as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise OSError(errno.EFBIG, f"it is larger than {max_bytes >> 20} MB")
    return data


def _check(status: os.stat_result, path: Path) -> None:
    if stat.S_ISLNK(status.st_mode):
        raise OSError(errno.ELOOP, IS_A_LINK, str(path))
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, NOT_A_REGULAR_FILE, str(path))
