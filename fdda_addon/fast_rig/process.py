# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a verb in another Blender, so that the open file stays unchanged and the window usable."""

import os
import queue
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Self, TextIO

import bpy

from ..core.errors import FDDAError, os_error_text
from ..core.progress import Progress
from ..core.temporary import temporary_folder_error
from ..training.environment.subprocesses import UTF8_OUTPUT, popen_options

ROOT = Path(__file__).resolve().parents[2]
KILL_AFTER_SECONDS = 5.0
"""Time after which a canceled process that still runs is killed."""
_PROGRESS_LINE = re.compile(r"(?P<stage>[a-z ]+): (?P<done>\d+) of (?P<total>\d+), ")
_ERROR_PREFIX = "Error: "
_REGISTER = (
    f"import bpy, importlib, sys; hasattr(bpy.types.Object, 'fdda') or (sys.path.insert(0, {str(ROOT)!r}), "
    f"importlib.import_module({Path(__file__).parents[1].name!r}).register())"
)
"""Expression that registers this add-on in a Blender that does not load it, as when it runs from source."""


class VerbProcess:
    """Context manager for a Blender without a window that runs a verb; it ends with the `with` block."""

    def __init__(self, verb: str, arguments: list[str]):
        """Start the process.

        Args:
            verb: the verb.
            arguments: its arguments.

        Raises:
            FDDAError: Blender cannot be started, or no temporary file can be written.
        """
        command, environment = _command()
        try:
            self._output = _new_output()
        except OSError as error:
            raise temporary_folder_error(error) from error
        try:
            self._process = subprocess.Popen(
                [*command, verb, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=self._output,
                stderr=subprocess.PIPE,
                env=environment,
                text=True,
                encoding="utf-8",
                errors="replace",
                **popen_options(),
            )
        except OSError as error:
            self._output.close()
            raise FDDAError(
                f"'{command[0]}' cannot be started ({os_error_text(error)}); use the verb {verb} in a terminal."
            ) from error
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        # In a thread, because reading a line blocks and Blender must not.
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self._process.stderr:
            self._lines.put(line)
        self._lines.put(None)

    @property
    def is_running(self) -> bool:
        """Return whether the process has not ended."""
        return self._process.poll() is None

    def steps(self) -> Iterator[Progress | str | None]:
        """Yield Progress, None while there is none, and at the end the output of the verb.

        Raises:
            FDDAError: the verb has failed; its text is that of the verb.
        """
        error_text = ""
        while True:
            try:
                line = self._lines.get_nowait()
            except queue.Empty:
                yield None
                continue
            if line is None:
                break
            if match := _PROGRESS_LINE.match(line):
                yield Progress(match["stage"], int(match["done"]), int(match["total"]))
            elif line.startswith(_ERROR_PREFIX):
                error_text = line.removeprefix(_ERROR_PREFIX).strip()
        while self.is_running:
            yield None
        if self._process.returncode:
            status = self._process.returncode
            raise FDDAError(error_text or f"The other Blender ended with status {status}, without a result.")
        self._output.seek(0)
        yield self._output.read()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.is_running:
            self._process.terminate()
            try:
                self._process.wait(KILL_AFTER_SECONDS)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._reader.join(KILL_AFTER_SECONDS)
        if not self._reader.is_alive():
            self._process.stderr.close()
        self._output.close()


def _new_output() -> TextIO:
    return tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace")


def _command() -> tuple[list[str], dict[str, str]]:
    """Return the start of the command line that runs a verb, and its environment variables."""
    environment = os.environ | UTF8_OUTPUT
    if bpy.app.binary_path:
        return [bpy.app.binary_path, "--python-expr", _REGISTER, "--command", "fdda"], environment
    # The bpy module in a Python has no program.
    paths = [str(ROOT), *filter(None, [environment.get("PYTHONPATH")])]
    return [sys.executable, "-m", "fdda_addon"], environment | {"PYTHONPATH": os.pathsep.join(paths)}
