# SPDX-License-Identifier: GPL-3.0-or-later
"""What the trainer says while it works: messages for the add-on, or text for a person."""

import sys
from typing import Protocol

from fdda_addon.core.messages import WARNING_LINE, Message, MessageType

WROTE = "Wrote '{model}': held-out error {held_out_mm:.4f} mm, {seconds:.1f} s."
LINE_EVERY = 0.1
"""Where the output is no terminal, a line of text follows this part of the epochs."""


class Announcer(Protocol):
    """Receives the messages of one training, in order."""

    def say(self, kind: MessageType, **values) -> None:
        """Announce a message; the keys of each type are in `core.messages`."""


class MessageLines:
    """Messages as JSON lines on stdout."""

    def say(self, kind: MessageType, **values) -> None:
        print(Message(kind, values).encode(), flush=True)


class Text:
    """Readable lines on stdout; the progress of a terminal stays on one line. Failures go to stderr elsewhere."""

    def __init__(self):
        self.terminal = sys.stdout.isatty()
        self.open_line = False
        self.shown = 0.0

    def say(self, kind: MessageType, **values) -> None:
        if kind is MessageType.PROGRESS:
            self._progress(**values)
            return
        if self.open_line:
            print()
            self.open_line = False
        text = {
            MessageType.STARTED: "Training {partitions} partitions, {vertices} vertices, {poses} poses, on {device}.",
            MessageType.PARTITION_FINISHED: "  {joint}: {basis} shapes, held-out error {held_out_mm:.4f} mm",
            MessageType.LOG: "{text}",
            MessageType.WARNING: WARNING_LINE,
            MessageType.MODEL_FINISHED: WROTE,
            MessageType.FINISHED: WROTE,
            MessageType.CANCELLED: "Cancelled; nothing was written.",
        }.get(kind)
        if text:
            print(text.format(**values), flush=True)

    def _progress(self, epoch: int, epochs: int, validation_mm: float, **_: float) -> None:
        if self.terminal:
            done = round(30 * epoch / epochs)
            bar = "#" * done + "." * (30 - done)
            print(f"\r[{bar}] epoch {epoch}/{epochs}, validation {validation_mm:.4f} mm ", end="", flush=True)
            self.open_line = True
        elif epoch == epochs or epoch >= self.shown + LINE_EVERY * epochs:
            self.shown = epoch
            print(f"epoch {epoch}/{epochs}, validation {validation_mm:.4f} mm", flush=True)
