# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a verb in another Blender, so that the open file stays unchanged and the window usable."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Self

import bpy

from ..core.errors import TRY_AGAIN, FDDAError, os_error_text
from ..core.files.child_process import OutputLines, child_options, end_process
from ..core.files.temporary import new_temporary_file
from ..core.progress import Job, Progress

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

        Raises:
            FDDAError: Blender cannot be started, or no temporary file can be written.
        """
        command = _command()
        self._output = new_temporary_file()
        try:
            self._process = subprocess.Popen(
                [*command, verb, *arguments],
                stdout=self._output,
                stderr=subprocess.PIPE,
                **child_options(ROOT),
            )
        except OSError as error:
            self._output.close()
            raise FDDAError(
                f"'{command[0]}' cannot be started ({os_error_text(error)}); use the verb {verb} in a terminal."
            ) from error
        self._lines = OutputLines(self._process.stderr)

    @property
    def is_running(self) -> bool:
        """Return whether the process has not ended."""
        return self._process.poll() is None

    def steps(self) -> Job[str]:
        """Yield the progress of the verb, and return its output.

        Raises:
            FDDAError: the verb has failed; text and exit status are those of the verb.
        """
        error_text = ""
        while (line := self._lines.next()) is not None:
            if not line:
                yield None
            elif match := _PROGRESS_LINE.match(line):
                yield Progress(match["stage"], int(match["done"]), int(match["total"]))
            elif line.startswith(_ERROR_PREFIX):
                error_text = line.removeprefix(_ERROR_PREFIX).strip()
        while self.is_running:
            yield None
        if self._process.returncode:
            status = self._process.returncode
            error = FDDAError(
                error_text
                or f"The other Blender ended with status {status}, without a result; disk or memory may be full."
            )
            error.exit_status = status if error_text else TRY_AGAIN
            raise error
        self._output.seek(0)
        return self._output.read()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.is_running:
            self._process.terminate()
        end_process(self._process, KILL_AFTER_SECONDS)
        if self._lines.join(KILL_AFTER_SECONDS):
            self._process.stderr.close()
        self._output.close()


def _command() -> list[str]:
    """Return the start of the command line that runs a verb."""
    if bpy.app.binary_path:
        return [bpy.app.binary_path, "--python-expr", _REGISTER, "--command", "fdda"]
    # The bpy module in a Python has no program.
    return [sys.executable, "-m", "fdda_addon"]
