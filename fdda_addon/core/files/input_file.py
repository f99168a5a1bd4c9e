# SPDX-License-Identifier: GPL-3.0-or-later
"""Opening of untrusted files.

Only regular files are opened: reading a pipe may block, a device may never end, and a link may lead out of a folder.
"""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

from .open_files import open_with_retry

NOT_A_REGULAR_FILE = "it is not a regular file"
IS_A_LINK = "it is a link to another place"
# A pipe may replace the file between check and open, and must not block. Windows has neither the flags nor such pipes.
_NONBLOCK_FLAG = getattr(os, "O_NONBLOCK", 0)
_NO_FOLLOW_FLAG = getattr(os, "O_NOFOLLOW", 0)


def open_input(path: Path, mode: str = "rb", follow_links: bool = True) -> BinaryIO:
    """Open a regular file.

    Args:
        mode: as for `open`; "x+b" creates a file that must not exist.
        follow_links: whether the path may be a symbolic link; pass False for files in untrusted folders.

    Raises:
        OSError: the file cannot be opened, or is a pipe, a device, a folder or, unless `follow_links`, a link.
    """
    return open_with_retry(lambda: _open(path, mode, follow_links))


def _open(path: Path, mode: str, follow_links: bool) -> BinaryIO:
    if "x" not in mode:
        _check_regular_file(os.stat(path, follow_symlinks=follow_links), path)
    extra_flags = _NONBLOCK_FLAG | (0 if follow_links else _NO_FOLLOW_FLAG)
    file = open(path, mode, opener=lambda name, flags: os.open(name, flags | extra_flags))  # noqa: SIM115 - the caller closes it
    try:
        _check_regular_file(os.fstat(file.fileno()), path)
    except OSError:
        file.close()
        raise
    return file


def read_input(path: Path, max_bytes: int, follow_links: bool = True) -> bytes:
    """Read the bytes of a regular file, as `open_input` opens it.

    Raises:
        OSError: `open_input` raised it, or the file has more than `max_bytes` bytes.
    """
    with open_input(path, follow_links=follow_links) as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise OSError(errno.EFBIG, f"it is larger than {max_bytes >> 20} MB")
    return data


def _check_regular_file(status: os.stat_result, path: Path) -> None:
    if stat.S_ISLNK(status.st_mode):
        raise OSError(errno.ELOOP, IS_A_LINK, str(path))
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, NOT_A_REGULAR_FILE, str(path))
