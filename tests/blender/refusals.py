# SPDX-License-Identifier: GPL-3.0-or-later
"""Verbs that must fail with one error message and exit status 1, and must leave all files unchanged."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.scene_rig import SceneRig

from .. import systems
from .conftest import run
from .scene_state import fresh_elbow

PROGRESS_LINE = re.compile(
    r"(poses to fit|fit|influences|target|poses|training|evaluation|benchmark|frames): \d+ of \d+, .*"
)


def file_contents(folder: Path) -> dict[str, bytes | None]:
    """Return the content of every file below a folder by relative path; the content of a folder is None."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")
    }


class Refusal:
    """A function that runs verbs which must fail; `folder` contains all files that they could change."""

    def __init__(self, folder: Path, capfd: pytest.CaptureFixture):
        self.folder, self._capfd = folder, capfd

    def __call__(self, *arguments: object, status: int = 1) -> str:
        """Run a verb that must end with an exit status, and return its error message."""
        before = file_contents(self.folder)
        self._capfd.readouterr()
        exit_status = run(*arguments)
        captured = self._capfd.readouterr()
        assert exit_status == status, captured
        lines = [line for line in captured.err.splitlines() if not PROGRESS_LINE.fullmatch(line)]
        assert len(lines) == 1, captured.err
        assert re.fullmatch(r"Error: .+[^.]\.", lines[0]), "a sentence"
        assert "Traceback" not in captured.out and "Error" not in captured.out
        assert file_contents(self.folder) == before, "files were changed"
        return lines[0].removeprefix("Error: ")


def save_elbow(path: Path, change: Callable[[SceneRig], object] = lambda rig: None) -> Path:
    """Build an elbow, change it and save it; return the path of the file."""
    change(fresh_elbow())
    save_copy(path)
    return path


@contextmanager
def limited_file_size(limit: int) -> Iterator[None]:
    """Limit the size of every file that this process writes, in bytes, to imitate a full disk."""
    resource = pytest.importorskip("resource", reason=systems.NO_FILE_SIZE_LIMITS)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def refused(call, *words: str) -> None:
    """Assert that an operator is canceled and that its report contains the words."""
    with pytest.raises(RuntimeError) as error:
        call()
    for word in words:
        assert word in str(error.value)
