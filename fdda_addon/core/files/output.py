# SPDX-License-Identifier: GPL-3.0-or-later
"""Atomic writing of files: a reader finds the old file, the new file or no file, but never an incomplete file."""

import errno
import json
import os
import re
import secrets
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import OutputError, os_error_text
from .file_kind import FileKind
from .open_files import remove_file, replace_file
from .path_limits import check_path, comparable_path, is_windows

TEMPORARY_PREFIX = ".fdda-"


def check_outputs(
    outputs: Mapping[Path, FileKind] | Iterable[tuple[Path, FileKind]],
    inputs: Iterable[Path] = (),
    overwrite: bool = False,
) -> None:
    """Check before a long job that its outputs can be written and replace no other data.

    Args:
        outputs: the files to write, each with its kind.
        inputs: the files that are read.
        overwrite: whether the user permits to overwrite inputs and files of another kind.

    Raises:
        OutputError: `check_writable` refuses an output; two outputs are the same file; or, unless `overwrite`, an
            output is an input or a file of another kind.
    """
    outputs = list(outputs.items() if isinstance(outputs, Mapping) else outputs)
    inputs, kind_names = list(inputs), {}
    for path, kind in outputs:
        check_writable(path)
        path_key = comparable_path(path)
        if path_key in kind_names:
            raise OutputError(
                f"Cannot write '{path}': it would be {kind_names[path_key]} and {kind.name}; give two names."
            )
        kind_names[path_key] = kind.name
        if overwrite or not os.path.exists(path):
            continue
        if any(os.path.exists(input_path) and os.path.samefile(path, input_path) for input_path in inputs):
            raise OutputError(f"Cannot write '{path}': it is read for this; give another name, or --overwrite.")
        try:
            has_kind = kind.matches(path)
        except OSError as error:
            raise OutputError(
                f"Cannot write '{path}': another file is there, {os_error_text(error)}; give another name."
            ) from error
        if not has_kind:
            raise OutputError(
                f"Cannot write '{path}': another file is there, which is not {kind.name}; give another name, or "
                "--overwrite."
            )


def check_writable(path: Path) -> None:
    """Check before a long job that a file can be written.

    Raises:
        OutputError: the folder does not exist or cannot be written, the path is a folder or a device, or `check_path`
            refuses it.
    """
    # Blender first writes to a temporary file whose name has one more character.
    check_path(path, path, path.parent / f"{_temporary_name(path)}@")
    # os.path, because methods of Path raise for a folder without permission.
    folder = path.parent
    if os.path.isdir(path):
        raise OutputError(f"Cannot write '{path}': it is a folder; give the name of a file.")
    if os.path.exists(path) and not os.path.isfile(path):
        # Renaming a file to the path of a device, such as /dev/null, would replace the device.
        raise OutputError(f"Cannot write '{path}': it is not a regular file; give the name of a file.")
    if is_windows() and os.path.exists(path) and not os.access(path, os.W_OK):
        raise OutputError(f"Cannot write '{path}': it is write-protected; give another name, or remove the protection.")
    if not os.path.isdir(folder):
        raise OutputError(f"Cannot write '{path}': the folder '{folder}' does not exist; create it first.")
    _check_can_create_file(path, folder, path.name)


def check_folder_writable(path: Path, names: Iterable[str] = ()) -> None:
    """Check before a long job that files can be written into a folder, which may not exist yet.

    Args:
        names: names of the files to write, relative to the folder.

    Raises:
        OutputError: the folder or its nearest existing parent cannot be written, or is a file; no parent exists; or
            `check_path` refuses a path.
    """
    files = [path / name for name in names]
    check_path(path, path, *files, *(file.with_name(_temporary_name(file)) for file in files))
    folder = nearest_existing_folder(path)
    if not os.path.isdir(folder):
        raise OutputError(f"Cannot write into '{path}': '{folder}' is a file; choose another folder.")
    _check_can_create_file(path, folder, next(iter(path.relative_to(folder).parts), ""))


def nearest_existing_folder(path: Path) -> Path:
    """Return a path itself where it exists, else its nearest existing parent.

    Raises:
        OutputError: no parent exists either, for instance because the drive is not connected.
    """
    folder = path
    while not os.path.exists(folder):
        if folder == folder.parent:
            raise OutputError(f"Cannot write into '{path}': '{folder}' does not exist; choose another folder.")
        folder = folder.parent
    return folder


def _check_can_create_file(path: Path, folder: Path, name: str) -> None:
    """Let the system judge a name, and create and remove a file with a name of the same length and end."""
    probe = folder / f"{TEMPORARY_PREFIX}{secrets.token_hex(2)}{name[len(TEMPORARY_PREFIX) + 4 :]}"
    try:
        with suppress(FileNotFoundError):
            os.lstat(folder / name)
        os.close(os.open(probe, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600))
    except OSError as error:
        raise OutputError(
            f"Cannot write '{path}': {os_error_text(error)}; choose a folder that you may write, or another name."
        ) from error
    with suppress(OSError):
        remove_file(probe)


@contextmanager
def atomic_write(path: Path, keep_on_failure: bool = True) -> Iterator[Path]:
    """Yield a temporary file beside `path`, and rename it to `path` when the block ends without an error.

    Args:
        path: path of the file.
        keep_on_failure: whether a file that is written, but cannot be renamed to `path`, is kept under its temporary
            name, which the error tells.

    Raises:
        OutputError: the file cannot be written or renamed, for instance because the disk is full.
    """
    with atomic_write_all(path, keep_on_failure=keep_on_failure) as (temporary,):
        yield temporary


@contextmanager
def atomic_write_all(*paths: Path, keep_on_failure: bool = True) -> Iterator[tuple[Path, ...]]:
    """Write several files as `atomic_write` does. When one file cannot be written or replaced, no file is changed."""
    temporaries: list[Path] = []
    try:
        for path in paths:
            temporary = path.with_name(_temporary_name(path))
            # Unlike a file of `tempfile.mkstemp`, it has the default permissions.
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666))
            temporaries.append(temporary)
        yield tuple(temporaries)
        for temporary in temporaries:
            with open(temporary, "r+b") as file:  # Windows flushes only files that are open for writing
                os.fsync(file.fileno())
    except OSError as error:
        others_text = f" with {_format_names(paths[1:])}" if len(paths) > 1 else ""
        raise OutputError(
            f"Cannot write '{paths[0]}'{others_text}: {os_error_text(error)}; nothing was changed."
        ) from error
    else:
        _rename_all(temporaries, paths, keep_on_failure)
    finally:
        for temporary in temporaries:
            with suppress(OSError):
                remove_file(temporary)


def _rename_all(temporaries: list[Path], paths: tuple[Path, ...], keep_on_failure: bool) -> None:
    """Rename the temporary files to their paths, after a check that no other program keeps one from being replaced.

    Temporary files that are kept leave the list.
    """
    renamed: list[Path] = []
    try:
        for path in filter(os.path.lexists, paths):
            if os.path.isdir(path):
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
            replace_file(path, path)
        for temporary, path in zip(temporaries, paths, strict=True):
            replace_file(temporary, path)
            renamed.append(path)
    except OSError as error:
        text = f"{_format_names(renamed)} was replaced, and no other" if renamed else "nothing was changed"
        if keep_on_failure:
            text += (
                f", and the new content is in {_format_names(temporaries[len(renamed) :])}; rename it when no program "
                f"has '{path.name}' open"
            )
            temporaries.clear()
        raise OutputError(f"Cannot write '{path}': {os_error_text(error)}; {text}.") from error


def _format_names(paths: Iterable[Path]) -> str:
    return ", ".join(f"'{path.name}'" for path in paths)


def _temporary_name(path: Path) -> str:
    """Return a name that nobody can predict."""
    return f"{TEMPORARY_PREFIX}{secrets.token_hex(6)}{path.suffix}"


def is_temporary_name(name: str) -> bool:
    """Return whether a file has a temporary name of `atomic_write`, left by a process that was killed while writing."""
    return re.fullmatch(r"\.fdda-[0-9a-f]{12}(\..*)?", name, re.DOTALL) is not None


def write_text(path: Path, text: str) -> None:
    """Write a text file as UTF-8 by `atomic_write`; invalid characters of file names are escaped."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: Path, value: object) -> None:
    """Write a JSON file by `atomic_write`; NaN and infinity raise ValueError."""
    write_text(path, to_json_text(value))


def to_json_text(value: object) -> str:
    """Return the text that `write_json` writes; raise ValueError for NaN and infinity."""
    return json.dumps(value, indent=1, allow_nan=False) + "\n"
