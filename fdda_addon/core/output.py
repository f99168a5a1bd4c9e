# SPDX-License-Identifier: GPL-3.0-or-later
"""Atomic writing of files: a reader finds the old file, the new one or none, but never an incomplete one."""

import errno
import json
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from .errors import OutputError, os_error_text
from .file_kind import FileKind
from .open_files import remove_file, replace_file
from .path_limits import check_path, comparable_path, is_windows

TEMPORARY_PREFIX = ".fdda-"
KEPT_PREFIX = "new-"
"""Prefix of a new file that could not replace the old one."""
_TEMPORARY_NAME = r"\.fdda-[0-9a-f]{12}(\..*)?"
"""Pattern of the temporary names of `atomic_write`."""


def check_outputs(
    outputs: Mapping[Path, FileKind] | Iterable[tuple[Path, FileKind]],
    inputs: Iterable[Path] = (),
    overwrite: bool = False,
) -> None:
    """Check before the work that outputs can be written and replace no other data.

    Args:
        outputs: the files to write, each with its kind.
        inputs: the files that are read.
        overwrite: the user permits to overwrite inputs and files of another kind.

    Raises:
        OutputError: as `check_writable`; two outputs are the same file; or, unless `overwrite`, one is an input or a
            file of another kind.
    """
    outputs = list(outputs.items() if isinstance(outputs, Mapping) else outputs)
    inputs, kind_names = list(inputs), {}
    for path, kind in outputs:
        check_writable(path)
        key = comparable_path(path)
        if key in kind_names:
            raise OutputError(f"Cannot write '{path}': it would be {kind_names[key]} and {kind.name}; give two names.")
        kind_names[key] = kind.name
        if overwrite or not os.path.exists(path):
            continue
        if any(os.path.exists(other) and os.path.samefile(path, other) for other in inputs):
            raise OutputError(f"Cannot write '{path}': it is read for this; give another name, or --overwrite.")
        if not _has_kind(path, kind):
            raise OutputError(
                f"Cannot write '{path}': another file is there, which is not {kind.name}; give another name, or "
                "--overwrite."
            )


def _has_kind(path: Path, kind: FileKind) -> bool:
    try:
        return kind.matches(path)
    except OSError as error:
        raise OutputError(
            f"Cannot write '{path}': another file is there, {os_error_text(error)}; give another name."
        ) from error


def check_writable(path: Path) -> None:
    """Check before the work that a file can be written.

    Raises:
        OutputError: the folder does not exist or cannot be written, the path is a folder or a device, or `check_path`
            refuses it.
    """
    # Blender also writes to a temporary file beside the file, whose name has one more character.
    check_path(path, path, path.parent / f"{_temporary_name(path)}@")
    # os.path, because methods of Path raise for a folder without permission.
    folder = path.parent
    if os.path.isdir(path):
        raise OutputError(f"Cannot write '{path}': it is a folder; give the name of a file.")
    if os.path.exists(path) and not os.path.isfile(path):
        # A rename would replace /dev/null.
        raise OutputError(f"Cannot write '{path}': it is not a regular file; give the name of a file.")
    if is_windows() and os.path.exists(path) and not os.access(path, os.W_OK):
        raise OutputError(f"Cannot write '{path}': it is write-protected; give another name, or remove the protection.")
    if not os.path.isdir(folder):
        raise OutputError(f"Cannot write '{path}': the folder '{folder}' does not exist; create it first.")
    _check_can_create_file(path, folder)


def check_folder_writable(path: Path, names: Iterable[str] = ()) -> None:
    """Check before the work that files can be written into a folder, which may not exist yet.

    Args:
        path: the folder.
        names: of the files to write, relative to the folder.

    Raises:
        OutputError: the folder, or the nearest one above it that exists, cannot be written, or is a file; no folder
            above it exists; or `check_path` refuses it.
    """
    files = [path / name for name in names]
    check_path(path, path, *files, *(file.with_name(_temporary_name(file)) for file in files))
    folder = nearest_existing_folder(path)
    if not os.path.isdir(folder):
        raise OutputError(f"Cannot write into '{path}': '{folder}' is a file; choose another folder.")
    _check_can_create_file(path, folder)


def nearest_existing_folder(path: Path) -> Path:
    """Return the path itself where it exists, else its nearest existing parent.

    Raises:
        OutputError: nothing exists, for instance because the drive is not connected.
    """
    folder = path
    while not os.path.exists(folder):
        if folder == folder.parent:
            raise OutputError(f"Cannot write into '{path}': '{folder}' does not exist; choose another folder.")
        folder = folder.parent
    return folder


def _check_can_create_file(path: Path, folder: Path) -> None:
    try:
        handle, probe = tempfile.mkstemp(prefix=TEMPORARY_PREFIX, dir=folder)
    except OSError as error:
        raise OutputError(
            f"Cannot write '{path}': {os_error_text(error)}; choose a folder that you may write."
        ) from error
    os.close(handle)
    with suppress(OSError):
        remove_file(Path(probe))


@contextmanager
def atomic_write(path: Path, keep: bool = True) -> Iterator[Path]:
    """Yield a temporary file beside `path`, and rename it to `path` when the block ends without an error.

    Args:
        path: the file.
        keep: keep a file that is written but cannot be renamed under another name beside `path`.

    Raises:
        OutputError: the file cannot be written or renamed, for instance because the disk is full.
    """
    with atomic_write_all(path, keep=keep) as (temporary,):
        yield temporary


@contextmanager
def atomic_write_all(*paths: Path, keep: bool = True) -> Iterator[tuple[Path, ...]]:
    """Write several files as `atomic_write` does: when one cannot be written or renamed, none is changed.

    Raises:
        OutputError: one cannot be written or renamed.
    """
    temporaries: list[Path] = []
    try:
        for path in paths:
            temporaries.append(_new_file(path))
        yield tuple(temporaries)
        for temporary in temporaries:
            with open(temporary, "r+b") as file:  # Windows flushes only what is open for writing
                os.fsync(file.fileno())
    except OSError as error:
        beside = f" with {_quoted(paths[1:])}" if len(paths) > 1 else ""
        raise OutputError(f"Cannot write '{paths[0]}'{beside}: {os_error_text(error)}; nothing was changed.") from error
    else:
        _commit(temporaries, paths, keep)
    finally:
        for temporary in temporaries:
            with suppress(OSError):
                remove_file(temporary)


def _commit(temporaries: list[Path], paths: tuple[Path, ...], keep: bool) -> None:
    """Rename all files or none."""
    backups: dict[Path, Path | None] = {}
    replaced: list[tuple[Path, Path]] = []
    try:
        for path in paths[:-1]:
            backups[path] = _backup(path)
        for temporary, path in zip(temporaries, paths, strict=True):
            replace_file(temporary, path)
            replaced.append((temporary, path))
    except BaseException as error:
        refused = paths[len(replaced) % len(paths)]
        changed = [path for temporary, path in reversed(replaced) if not _restore(temporary, path, backups[path])]
        if not isinstance(error, OSError):
            raise
        text = f"{_quoted(changed)} was replaced, and no other" if changed else "nothing was changed"
        if keep and not changed and (kept := _keep_beside(temporaries, paths)):
            rename = f"rename {'it' if len(kept) == 1 else 'them'}"
            way = f"close the program that has '{refused.name}' open, and" if error.errno == errno.EBUSY else "then"
            new_files = "the new file is" if len(kept) == 1 else "the new files are"
            text += f", and {new_files} kept as {_quoted(kept)}; {way} {rename}"
        raise OutputError(f"Cannot write '{refused}': {os_error_text(error)}; {text}.") from error
    finally:
        for path, backup in backups.items():
            if backup and os.path.lexists(path):
                with suppress(OSError):
                    remove_file(backup)


def _backup(path: Path) -> Path | None:
    """Link or copy a file to a temporary name before it is replaced; None where it does not exist."""
    if not os.path.lexists(path):
        return None
    backup = path.with_name(_temporary_name(path))
    try:
        os.link(path, backup)
    except OSError:
        # Not every file system has hard links.
        shutil.copy2(path, backup)
    return backup


def _restore(temporary: Path, path: Path, backup: Path | None) -> bool:
    """Undo the renaming of a file to `path`; return whether that succeeded."""
    try:
        replace_file(path, temporary)
        if backup:
            replace_file(backup, path)
    except OSError:
        return False
    return True


def _keep_beside(temporaries: list[Path], paths: tuple[Path, ...]) -> list[Path]:
    """Rename files that could not replace `paths` to names beside them; return these names."""
    for attempt in count(1):
        prefix = KEPT_PREFIX if attempt == 1 else f"{KEPT_PREFIX}{attempt}-"
        new_paths = [path.with_name(f"{prefix}{path.name}") for path in paths]
        if not any(os.path.lexists(new_path) for new_path in new_paths):
            break
    kept = []
    for temporary, new_path in zip(temporaries, new_paths, strict=True):
        with suppress(OSError):
            replace_file(temporary, new_path)
            kept.append(new_path)
    return kept


def _quoted(paths: Iterable[Path]) -> str:
    return ", ".join(f"'{path.name}'" for path in paths)


def _new_file(path: Path) -> Path:
    """Create an empty file with an unpredictable name beside a path.

    Unlike `tempfile.mkstemp`, the file gets the usual permissions.
    """
    temporary = path.with_name(_temporary_name(path))
    os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666))
    return temporary


def _temporary_name(path: Path) -> str:
    return f"{TEMPORARY_PREFIX}{secrets.token_hex(6)}{path.suffix}"


def is_temporary_name(name: str) -> bool:
    """Return whether a name is one of `atomic_write`, left by a process that was killed while writing."""
    return re.fullmatch(_TEMPORARY_NAME, name, re.DOTALL) is not None


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically as UTF-8; invalid characters of file names are escaped.

    Raises:
        OutputError: as `atomic_write`.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: Path, value: object) -> None:
    """Write a JSON file atomically; NaN and infinity raise ValueError.

    Raises:
        OutputError: as `atomic_write`.
    """
    write_text(path, to_json_text(value))


def to_json_text(value: object) -> str:
    """Return the text that `write_json` writes; raise ValueError for NaN and infinity."""
    return json.dumps(value, indent=1, allow_nan=False) + "\n"
