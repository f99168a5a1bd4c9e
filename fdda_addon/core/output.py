# SPDX-License-Identifier: GPL-3.0-or-later
"""Writing files so that a reader finds the old one, the new one, or none; never a half."""

import json
import os
import re
import secrets
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import OutputError
from .file_kind import FileKind

TEMPORARY = ".fdda-"
_LEFT_OVER = r"\.fdda-[0-9a-f]{12}(\..*)?|\.\d+-recording\.json"
"""Names that `replacing` gives, and those that earlier versions gave to the index of a recording."""


def check_outputs(
    outputs: Mapping[Path, FileKind] | Iterable[tuple[Path, FileKind]],
    inputs: Iterable[Path] = (),
    overwrite: bool = False,
) -> None:
    """Fail before the work when what a verb writes could not be written, or would take something away.

    Args:
        outputs: the files that it writes, and of which kind each is.
        inputs: the files that it reads.
        overwrite: the user said that it may write over what it reads, and over files of another kind.

    Raises:
        OutputError: as `check_writable`; two outputs are one file; or, unless `overwrite`, one is read, or holds
            something of another kind.
    """
    outputs = list(outputs.items() if isinstance(outputs, Mapping) else outputs)
    inputs, places = list(inputs), {}
    for path, kind in outputs:
        check_writable(path)
        place = os.path.realpath(path)
        if place in places:
            raise OutputError(f"Cannot write '{path}': it would be {places[place]} and {kind.name}; give two names.")
        places[place] = kind.name
        if overwrite or not os.path.exists(path):
            continue
        if any(os.path.exists(other) and os.path.samefile(path, other) for other in inputs):
            raise OutputError(f"Cannot write '{path}': it is read for this; give another name, or --overwrite.")
        if not _is_of(path, kind):
            raise OutputError(
                f"Cannot write '{path}': another file is there, which is not {kind.name}; give another name, or "
                "--overwrite."
            )


def _is_of(path: Path, kind: FileKind) -> bool:
    try:
        return kind.is_of(path)
    except OSError as error:
        raise OutputError(
            f"Cannot write '{path}': another file is there, {error.strerror}; give another name."
        ) from error


def check_writable(path: Path) -> None:
    """Fail before the work rather than after it when a file could not be written.

    Raises:
        OutputError: the folder does not exist or cannot be written, or the path is a folder or a device.
    """
    # os.path: the methods of Path raise for a folder that may not be entered.
    folder = path.parent
    if os.path.isdir(path):
        raise OutputError(f"Cannot write '{path}': it is a folder; give the name of a file.")
    if os.path.exists(path) and not os.path.isfile(path):
        # A rename would put a file in the place of /dev/null.
        raise OutputError(f"Cannot write '{path}': it is no ordinary file; give the name of a file.")
    if not os.path.isdir(folder):
        raise OutputError(f"Cannot write '{path}': the folder '{folder}' does not exist; create it first.")
    _probe(path, folder)


def check_folder_writable(path: Path) -> None:
    """Fail before the work rather than after it when files could not be written into a folder that may not exist yet.

    Raises:
        OutputError: the folder, or the nearest one above it that exists, cannot be written, or is a file, or no folder
            above it exists.
    """
    folder = nearest_folder(path)
    if not os.path.isdir(folder):
        raise OutputError(f"Cannot write into '{path}': '{folder}' is a file; choose another folder.")
    _probe(path, folder)


def nearest_folder(path: Path) -> Path:
    """Find what exists of a path: the path itself, or the nearest folder above it.

    Raises:
        OutputError: nothing exists, for instance because the drive is not connected.
    """
    folder = path
    while not os.path.exists(folder):
        if folder == folder.parent:
            raise OutputError(f"Cannot write into '{path}': '{folder}' does not exist; choose another folder.")
        folder = folder.parent
    return folder


def _probe(path: Path, folder: Path) -> None:
    try:
        handle, probe = tempfile.mkstemp(prefix=TEMPORARY, dir=folder)
    except OSError as error:
        raise OutputError(f"Cannot write '{path}': {error.strerror}; choose a folder that you may write.") from error
    os.close(handle)
    os.unlink(probe)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary file beside `path`, and rename it to `path` when the block ends without an error.

    Raises:
        OutputError: the file cannot be written or renamed, for instance because the disk is full.
    """
    with replacing_all(path) as (temporary,):
        yield temporary


@contextmanager
def replacing_all(*paths: Path) -> Iterator[tuple[Path, ...]]:
    """As `replacing`, of files that belong together: when one cannot be written, none is changed.

    Raises:
        OutputError: one cannot be written or renamed.
    """
    temporaries: list[Path] = []
    renamed: list[str] = []
    try:
        for path in paths:
            temporaries.append(_new_file(path))
        yield tuple(temporaries)
        for temporary in temporaries:
            with open(temporary, "r+b") as file:  # Windows flushes only what is open for writing
                os.fsync(file.fileno())
        for temporary, path in zip(temporaries, paths, strict=True):
            os.replace(temporary, path)
            renamed.append(f"'{path.name}'")
    except OSError as error:
        beside = f" with {', '.join(repr(path.name) for path in paths[1:])}" if len(paths) > 1 else ""
        changed = f"{', '.join(renamed)} was replaced, and no other" if renamed else "nothing was changed"
        raise OutputError(f"Cannot write '{paths[0]}'{beside}: {error.strerror or error}; {changed}.") from error
    finally:
        for temporary in temporaries:
            with suppress(OSError):
                temporary.unlink()


def _new_file(path: Path) -> Path:
    """An empty file beside a path, which nobody could foresee or put a link in the place of.

    As `tempfile.mkstemp` makes them, but with the permissions of any other new file.
    """
    temporary = path.with_name(f"{TEMPORARY}{secrets.token_hex(6)}{path.suffix}")
    os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666))
    return temporary


def is_left_over(name: str) -> bool:
    """Whether a file of this name was left by a process that was ended while it wrote."""
    return re.fullmatch(_LEFT_OVER, name, re.DOTALL) is not None


def write_text(path: Path, text: str) -> None:
    """Replace a file with text, UTF-8; parts of file names that are none are escaped.

    Raises:
        OutputError: as `replacing`.
    """
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: Path, value: object) -> None:
    """Replace a file with JSON; NaN and infinity are refused.

    Raises:
        OutputError: as `replacing`.
    """
    write_text(path, json_text(value))


def json_text(value: object) -> str:
    """A value as `write_json` writes it; ValueError for NaN and infinity."""
    return json.dumps(value, indent=1, allow_nan=False) + "\n"
