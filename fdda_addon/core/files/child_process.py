# SPDX-License-Identifier: GPL-3.0-or-later
"""The one way to start another program: its environment variables, its lines of output, and its end."""

import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

KEPT_PYTHON_VARIABLES = {"PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX", "PYTHONNOUSERSITE"}
"""Variables of Python that change neither what a child process imports, except for fewer packages, nor what it does."""
DROPPED_VARIABLES = {"VIRTUAL_ENV", "__PYVENV_LAUNCHER__"}


def child_environment(*import_folders: Path) -> dict[str, str]:
    """Return the environment variables of a child process, without Python's own such as PYTHONHOME.

    The launcher of a pipeline sets them for another Python. Blender ignores them, and its child processes must, too.

    Args:
        import_folders: folders that a Python imports from, besides the folders of PYTHONPATH that this Python uses.
    """
    used_folders = set(map(os.path.abspath, sys.path))
    inherited = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    paths = [*map(str, import_folders), *(path for path in inherited if os.path.abspath(path) in used_folders)]
    environment = {
        name: value
        for name, value in os.environ.items()
        if name in KEPT_PYTHON_VARIABLES or not (name.startswith("PYTHON") or name in DROPPED_VARIABLES)
    }
    # Without it, pipes on Windows use the local code page.
    environment["PYTHONIOENCODING"] = "utf-8:backslashreplace"
    return environment | ({"PYTHONPATH": os.pathsep.join(dict.fromkeys(paths))} if paths else {})


def child_options(*import_folders: Path, own_session: bool = False) -> dict:
    """Return options of `subprocess` for a child process: no input, output as UTF-8, and no console window on Windows.

    Args:
        import_folders: as in `child_environment`.
        own_session: whether the process continues after Ctrl-C in the terminal, and after the terminal is closed.
    """
    options = {
        "stdin": subprocess.DEVNULL,
        "env": child_environment(*import_folders),
        "encoding": "utf-8",
        "errors": "replace",
    }
    if os.name != "nt":
        return options | {"start_new_session": own_session}
    group = subprocess.CREATE_NEW_PROCESS_GROUP if own_session else 0
    return options | {"creationflags": subprocess.CREATE_NO_WINDOW | group}


class OutputLines:
    """Lines of a child process, read in a thread, because reading a line blocks and Blender must not."""

    def __init__(self, lines: Iterable[str]):
        self._lines, self._queue = lines, queue.SimpleQueue()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        for line in self._lines:
            self._queue.put(line)
        self._queue.put(None)

    def next(self, wait_seconds: float = 0.0) -> str | None:
        """Return the next line with its line end; empty if there is none yet, None after the last line."""
        try:
            return self._queue.get(wait_seconds > 0, wait_seconds)
        except queue.Empty:
            return ""

    def join(self, seconds: float | None = None) -> bool:
        """Wait for the last line; return whether it was read. Another process may hold the pipe open."""
        self._thread.join(seconds)
        return not self._thread.is_alive()


def end_process(process: subprocess.Popen, wait_seconds: float = 0.0) -> None:
    """Wait until a process has ended; kill it after `wait_seconds`, or if Ctrl-C interrupts the wait."""
    try:
        with suppress(subprocess.TimeoutExpired):
            process.wait(wait_seconds)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
