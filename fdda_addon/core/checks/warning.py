# SPDX-License-Identifier: GPL-3.0-or-later
"""Warnings about a recording, and formatting that their sentences share."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from ..errors import RecordingError
from ..formats.messages import WARNING_LINE
from ..rig import STATIC_JOINT_LABEL, Rig


@dataclass(frozen=True)
class RecordingWarning:
    """A property of a recording that makes a bad model likely.

    Attributes:
        name: name of the kind of warning, a heading in docs/formats.md.
        text: one sentence that tells the user the problem, with names and numbers, and the remedy.
    """

    name: str
    text: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", self.text[0].upper() + self.text[1:])

    def __str__(self) -> str:
        return WARNING_LINE.format(name=self.name, text=self.text)

    def to_json(self) -> dict:
        return asdict(self)


def raise_first_warning(warnings: Sequence[RecordingWarning]) -> None:
    """Raise an error with the first warning and the names of the others.

    Raises:
        RecordingError: `warnings` is not empty.
    """
    if not warnings:
        return
    other_names = [warning.name for warning in warnings[1:]]
    others_text = f"; {len(other_names)} more: {', '.join(other_names)}" if other_names else ""
    raise RecordingError(f"{warnings[0].text.removesuffix('.')} ({warnings[0].name}{others_text}).")


def joint_name(rig: Rig, joint: int) -> str:
    """Return the name of a joint for messages, or the label of the static joint."""
    return rig.joints[joint].name or STATIC_JOINT_LABEL


def format_length(rig: Rig, units: float) -> str:
    """Format a length in mesh units: "0.04 mm", "87 mm", "1.2 m"."""
    meters = units * rig.metres_per_unit
    if meters < 1:
        return f"{meters * 1000:.2g} mm" if meters < 0.1 else f"{meters * 1000:.0f} mm"
    return f"{meters:.3g} m"
