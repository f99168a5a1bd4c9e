# SPDX-License-Identifier: GPL-3.0-or-later
"""Warnings about a recording, and formatting that their sentences share."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from ..errors import RecordingError
from ..formats.messages import WARNING_LINE
from ..rig import STATIC_JOINT_LABEL, Rig

MAX_LISTED = 3
"""Largest number of names that a message lists."""


@dataclass(frozen=True)
class RecordingWarning:
    """A property of a recording that makes a bad model likely.

    Attributes:
        name: name of the kind of warning, a heading in docs/formats.md.
        text: one sentence that tells the user the problem, with names and numbers, and the remedy.
    """

    name: str
    text: str

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


def format_list(names: Sequence[object], max_names: int = MAX_LISTED) -> str:
    """Format the first names or numbers of a list: "'a', 'b', 'c' and 4 more"; strings are quoted."""
    shown_names = [f"'{name}'" if isinstance(name, str) else str(name) for name in names[:max_names]]
    if len(names) > max_names:
        return f"{', '.join(shown_names)} and {len(names) - max_names} more"
    return f"{', '.join(shown_names[:-1])} and {shown_names[-1]}" if len(shown_names) > 1 else "".join(shown_names)


def format_with_noun(names: Sequence[object], noun: str, plural: str = "") -> str:
    """Format names with a noun: "the joint 'a'", "the 7 joints 'a', 'b', 'c' and 4 more"."""
    if len(names) == 1:
        return f"the {noun} {format_list(names)}"
    return f"the {len(names)} {plural or noun + 's'} {format_list(names)}"


def joint_name(rig: Rig, joint: int) -> str:
    """Return the name of a joint for messages, or the label of the static joint."""
    return rig.joints[joint].name or STATIC_JOINT_LABEL


def format_length(rig: Rig, units: float) -> str:
    """Format a length in mesh units: "0.04 mm", "87 mm", "1.2 m"."""
    meters = units * rig.metres_per_unit
    if meters < 1:
        return f"{meters * 1000:.2g} mm" if meters < 0.1 else f"{meters * 1000:.0f} mm"
    return f"{meters:.3g} m"
