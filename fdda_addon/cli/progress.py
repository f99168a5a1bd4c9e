# SPDX-License-Identifier: GPL-3.0-or-later
"""Prints progress to stderr: as a bar on a terminal, else as plain lines."""

import sys
import time
from typing import TextIO

from ..core.progress import Job, Result, run_job

BAR_WIDTH = 30
PLAIN_LINES_PER_STAGE = 10
"""Number of lines for each stage if stderr is no terminal."""


class ProgressPrinter:
    """Context manager that prints the progress of a job, and ends the line of the progress bar at its end."""

    def __init__(self, stream: TextIO | None = None):
        self._stream = stream or sys.stderr
        self._uses_bar = self._stream.isatty()
        self._stage, self._last_tenth, self._start, self._has_open_line = "", -1, 0.0, False

    def run(self, job: Job[Result]) -> Result:
        """Iterate a job, print its progress, and return its result."""
        return run_job(job, lambda step: self.show(step.stage, step.done, step.total, step.detail))

    def show(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Print that `done` of `total` steps of a stage are complete."""
        if stage != self._stage:
            self.end_line()
            self._stage, self._last_tenth, self._start = stage, -1, time.monotonic()
        seconds = time.monotonic() - self._start
        note = f"  {note}" if note else ""
        if self._uses_bar:
            filled = BAR_WIDTH * done // max(total, 1)
            bar = "█" * filled + "░" * (BAR_WIDTH - filled)
            self._stream.write(f"\r{stage:<12} {bar} {done}/{total}  {seconds:.0f} s{note}\x1b[K")
            self._has_open_line = True
        elif (tenth := PLAIN_LINES_PER_STAGE * done // max(total, 1)) != self._last_tenth:
            self._last_tenth = tenth
            self._stream.write(f"{stage}: {done} of {total}, {seconds:.1f} s{note}\n")
        self._stream.flush()

    def say(self, text: str) -> None:
        """Print a text in a separate line."""
        self.end_line()
        self._stream.write(f"{text}\n")
        self._stream.flush()

    def end_line(self) -> None:
        """End the line of the progress bar, so that other text can be printed."""
        if self._has_open_line:
            self._stream.write("\n")
            self._stream.flush()
            self._has_open_line = False

    def __enter__(self) -> "ProgressPrinter":
        return self

    def __exit__(self, *_: object) -> None:
        self.end_line()
