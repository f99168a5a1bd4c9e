# SPDX-License-Identifier: GPL-3.0-or-later
"""What the trainer says while it works: one JSON object a line on its stdout.

Direction: trainer to add-on. Every training ends with exactly one of `FINISHED`, `CANCELLED` and `FAILED`. The add-on
asks the trainer to stop by creating the file that `STOP_FILE_VARIABLE` names: no signal does that on Windows.
"""

import enum
import json
from dataclasses import dataclass, field

STOP_FILE_VARIABLE = "FDDA_STOP_FILE"
"""Environment variable of the trainer: path of a file that does not exist until the trainer is to stop."""
WARNING_LINE = "Warning ({name}): {text}"
"""A warning for people, from its values."""


class MessageType(enum.Enum):
    """Types of a message, with the keys that it carries beside `type`."""

    STARTED = "started"
    """partitions: int, poses: int, vertices: int, device: str."""
    PREPARING = "preparing"
    """done: int, total: int (partitions whose residuals have been turned into shapes)."""
    PROGRESS = "progress"
    """epoch: int, epochs: int, training_mm: float, validation_mm: float (mean errors of the training and the validation
    poses). Of a fit of skin weights: done: int, total: int (vertices)."""
    PARTITION_FINISHED = "partition_finished"
    """joint: str, basis: int, held_out_mm: float (mean error of the held-out poses)."""
    LOG = "log"
    """text: str."""
    WARNING = "warning"
    """name: str, text: str: something about the recording that makes a bad model likely (`core.checks.warning`)."""
    MODEL_FINISHED = "model_finished"
    """As `FINISHED`, of one of several models that are trained in turn: each has its own `STARTED` before it."""
    FINISHED = "finished"
    """model: str (path), seconds: float, held_out_mm and held_out_p999_mm: float (mean and percentile 99.9);
    verdict: str, "met", "missed" or "exhausted", where there is a goal. Of several models: model is their folder, the
    errors are the largest of them, models: int. Of a fit of skin weights: seconds: float,
    fit: dict (`SkinFit.to_json`)."""
    CANCELLED = "cancelled"
    """No keys. The trainer was asked to stop and wrote no model."""
    FAILED = "failed"
    """text: str, the sentence for the user."""

    @property
    def is_last(self) -> bool:
        return self in (MessageType.FINISHED, MessageType.CANCELLED, MessageType.FAILED)


@dataclass(frozen=True)
class Message:
    """A message and the values of its keys."""

    type: MessageType
    values: dict = field(default_factory=dict)

    def encode(self) -> str:
        """One line of JSON, without the line's end."""
        return json.dumps({"type": self.type.value, **self.values})

    @staticmethod
    def decode(line: str) -> "Message":
        """Read one line.

        Raises:
            ValueError: the line is no message.
        """
        values = json.loads(line)
        if not isinstance(values, dict):
            raise ValueError(f"not a trainer message: {line[:80]!r}")
        return Message(MessageType(values.pop("type", None)), values)
