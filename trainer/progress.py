# SPDX-License-Identifier: GPL-3.0-or-later
"""Output of the trainer: a line of JSON for each message."""

import threading

from fdda_addon.core.formats.messages import Message, MessageType

OUTPUT_LOCK = threading.RLock()
"""Held while a message is written, because the thread that waits for a stop request writes one, too."""


class MessageSink:
    """Writes the messages of one training to stdout, in order."""

    def send(self, message_type: MessageType, **values) -> None:
        """Send a message; `core.formats.messages` has the keys of each type."""
        with OUTPUT_LOCK:
            print(Message(message_type, values).encode(), flush=True)
