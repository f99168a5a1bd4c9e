# SPDX-License-Identifier: GPL-3.0-or-later
"""Messages of the trainer to the add-on: one JSON object per line on stdout.

Every training ends with exactly one message of type `FINISHED`, `CANCELLED` or `FAILED`. The add-on asks the trainer
to stop by creating the file that `STOP_FILE_VARIABLE` names, because Windows has no signal for this purpose.
"""

import enum
import json
from dataclasses import dataclass, field

STOP_FILE_VARIABLE = "FDDA_STOP_FILE"
"""Environment variable of the trainer: path of a file that is created to stop the trainer."""
WARNING_LINE = "Warning ({name}): {text}"
"""Text of a warning on the command line."""
KEY_JOINTS_STAGE, FIT_STAGE, PARTITIONS_STAGE = "key joints", "fit", "partitions"
"""Stages of the message `PREPARING`."""


class MessageType(enum.Enum):
    """Types of messages. The docstring of each type lists its keys, apart from the key `type`."""

    STARTED = "started"
    """partitions: int, poses: int, vertices: int, device: str."""
    PREPARING = "preparing"
    """stage: str, done: int, total: int: "key joints" (decided joints), "fit" (vertices with fitted skin weights), or
    "partitions" (whose principal components are computed)."""
    PROGRESS = "progress"
    """epoch: int, epochs: int, training_mm: float, validation_mm: float (mean errors of the training and the validation
    poses)."""
    PARTITION_FINISHED = "partition_finished"
    """joint: str, basis: int, held_out_mm: float (mean error of the held-out poses)."""
    LOG = "log"
    """text: str."""
    WARNING = "warning"
    """name: str, text: str. A property of the recording that makes a bad model likely (`core.checks.warning`), or a
    graphics card that cannot be used. Then the next `PROGRESS` may have epoch 1 again."""
    FINISHED = "finished"
    """model: str (path), seconds: float, held_out_mm and held_out_p999_mm: float (mean and percentile 99.9);
    verdict: str, "met", "missed" or "exhausted", where there is a goal."""
    CANCELLED = "cancelled"
    """No keys. The trainer was asked to stop and wrote no model."""
    FAILED = "failed"
    """text: str, the sentence that the user sees."""

    @property
    def is_last(self) -> bool:
        """Whether a message of this type is the last of a training."""
        return self in (MessageType.FINISHED, MessageType.CANCELLED, MessageType.FAILED)


@dataclass(frozen=True)
class Message:
    """A message with the values of its keys."""

    type: MessageType
    values: dict = field(default_factory=dict)

    def encode(self) -> str:
        """Return the message as one line of JSON, without the line end."""
        return json.dumps({"type": self.type.value, **self.values})

    @staticmethod
    def decode(line: str) -> "Message":
        """Read a message from one line.

        Raises:
            ValueError: the line is not a message.
        """
        values = json.loads(line)
        if not isinstance(values, dict):
            raise ValueError(f"not a trainer message: {line[:80]!r}")
        return Message(MessageType(values.pop("type", None)), values)
