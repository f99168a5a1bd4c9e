# SPDX-License-Identifier: GPL-3.0-or-later
"""Progress on stderr: a bar on a terminal, plain lines elsewhere."""

import sys
import time
from typing import TextIO

WIDTH = 30
PLAIN_PARTS = 10
"""Plain output has a line for each tenth of a stage."""


class ProgressPrinter:
    """Prints how far the stages of a job are; use as a context manager, so that a bar's line is always ended."""

    def __init__(self, stream: TextIO | None = None):
        self._stream = stream or sys.stderr
        self._bar = self._stream.isatty()
        self._stage, self._part, self._start, self._open = "", -1, 0.0, False

    def show(self, stage: str, done: int, total: int, note: str = "") -> None:
        """Show `done` of `total` steps of a stage."""
        if stage != self._stage:
            self.end_line()
            self._stage, self._part, self._start = stage, -1, time.monotonic()
        seconds = time.monotonic() - self._start
        note = f"  {note}" if note else ""
        if self._bar:
            filled = WIDTH * done // max(total, 1)
            bar = "█" * filled + "░" * (WIDTH - filled)
            self._stream.write(f"\r{stage:<12} {bar} {done}/{total}  {seconds:.0f} s{note}\x1b[K")
            self._open = True
        elif (part := PLAIN_PARTS * done // max(total, 1)) != self._part:
            self._part = part
            self._stream.write(f"{stage}: {done} of {total}, {seconds:.1f} s{note}\n")
        self._stream.flush()

    def say(self, text: str) -> None:
        """Print a line of its own."""
        self.end_line()
        self._stream.write(f"{text}\n")
        self._stream.flush()

    def end_line(self) -> None:
        """End the line of a bar, so that something else can be printed."""
        if self._open:
            self._stream.write("\n")
            self._stream.flush()
            self._open = False

    def __enter__(self) -> "ProgressPrinter":
        return self

    def __exit__(self, *_: object) -> None:
        self.end_line()
