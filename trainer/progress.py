# SPDX-License-Identifier: GPL-3.0-or-later
"""Output of the trainer's progress: JSON messages for the add-on, or text for a person."""

import sys
import threading
from typing import Protocol

from fdda_addon.core.formats.messages import WARNING_LINE, Message, MessageType

LINE_FORMATS = {
    MessageType.STARTED: "Training {partitions} partitions, {vertices} vertices, {poses} poses, on {device}.",
    MessageType.PARTITION_FINISHED: "  {joint}: {basis} components, held-out error {held_out_mm:.4f} mm",
    MessageType.LOG: "{text}",
    MessageType.WARNING: WARNING_LINE,
    MessageType.FINISHED: "Wrote '{model}': held-out error {held_out_mm:.4f} mm, {seconds:.1f} s.",
    MessageType.CANCELLED: "Cancelled before the model was written.",
}
LINE_EPOCH_INTERVAL = 0.1
"""Part of the epochs between two lines of progress, if stdout is not a terminal."""
BAR_WIDTH = 30
"""Characters of the progress bar."""
OUTPUT_LOCK = threading.RLock()
"""Held while a message is written, because the thread that waits for a stop request writes one, too."""


class MessageSink(Protocol):
    """Receives the messages of one training, in order."""

    def send(self, message_type: MessageType, **values) -> None:
        """Send a message; `core.formats.messages` has the keys of each type."""


class JsonMessageSink:
    """Writes messages as JSON lines to stdout."""

    def send(self, message_type: MessageType, **values) -> None:
        """Send a message."""
        with OUTPUT_LOCK:
            print(Message(message_type, values).encode(), flush=True)


class TextMessageSink:
    """Writes text to stdout; on a terminal, progress stays on one line. `run_with_messages` prints failures."""

    def __init__(self):
        self.is_terminal = sys.stdout.isatty()
        self.has_open_line = False
        self.last_shown_epoch = 0.0

    def send(self, message_type: MessageType, **values) -> None:
        """Send a message."""
        with OUTPUT_LOCK:
            if message_type is MessageType.PROGRESS:
                self._show_progress(**values)
                return
            if self.has_open_line:
                print()
                self.has_open_line = False
            if line := LINE_FORMATS.get(message_type):
                print(line.format(**values), flush=True)

    def _show_progress(self, epoch: int, epochs: int, validation_mm: float, **_: float) -> None:
        if self.is_terminal:
            filled = round(BAR_WIDTH * epoch / epochs)
            bar = "#" * filled + "." * (BAR_WIDTH - filled)
            print(f"\r[{bar}] epoch {epoch}/{epochs}, validation {validation_mm:.4f} mm ", end="", flush=True)
            self.has_open_line = True
        elif epoch == epochs or epoch >= self.last_shown_epoch + LINE_EPOCH_INTERVAL * epochs:
            self.last_shown_epoch = epoch
            print(f"epoch {epoch}/{epochs}, validation {validation_mm:.4f} mm", flush=True)
