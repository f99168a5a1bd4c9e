# SPDX-License-Identifier: GPL-3.0-or-later
"""What a refused command line must look like: one sentence, exit status 1, no file touched."""

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
    """Content of every file below a folder by path; None for a folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")
    }


class Refusal:
    """Runs verbs that must be refused; `folder` holds all files that they could touch."""

    def __init__(self, folder: Path, capfd: pytest.CaptureFixture):
        self.folder, self._capfd = folder, capfd

    def __call__(self, *arguments: object, status: int = 1) -> str:
        """Run a verb that ends with an exit status, and return its sentence."""
        before = file_contents(self.folder)
        self._capfd.readouterr()
        ended = run(*arguments)
        captured = self._capfd.readouterr()
        assert ended == status, captured
        lines = [line for line in captured.err.splitlines() if not PROGRESS_LINE.fullmatch(line)]
        assert len(lines) == 1, captured.err
        assert re.fullmatch(r"Error: .+[^.]\.", lines[0]), "a sentence"
        assert "Traceback" not in captured.out and "Error" not in captured.out
        assert file_contents(self.folder) == before, "files were touched"
        return lines[0].removeprefix("Error: ")


def save_elbow(path: Path, change: Callable[[SceneRig], object] = lambda rig: None) -> Path:
    """Save an elbow that something was done to."""
    change(fresh_elbow())
    save_copy(path)
    return path


@contextmanager
def limited_file_size(limit: int) -> Iterator[None]:
    """No file grows beyond so many bytes: what a full disk looks like to the one who writes."""
    resource = pytest.importorskip("resource", reason=systems.NO_FILE_SIZE_LIMITS)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
