# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings that the sidebar, the command line, the trainer and scripts share. Each is declared once.

A dataclass has them as fields (`Setting.field`); options and Blender's properties are made from the declarations.
"""

import argparse
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

ABOVE_ZERO = sys.float_info.min
"""The smallest number above 0, as a lower limit."""


@dataclass(frozen=True)
class Setting:
    """A setting.

    Attributes:
        name: name of its field and of its property. The option is `--name` with hyphens.
        default: the default, whose type all values have; a tuple for a list.
        description: tooltip in the sidebar, and help of the option.
        label: label in the sidebar.
        low, high: the smallest and the largest value.
        choices: the values of a text, if not all are valid.
        metavar: the value in the help of the option.
        ui: further arguments of Blender's property.
    """

    name: str
    default: Any
    description: str
    label: str = ""
    low: float = 0
    high: float = sys.float_info.max
    choices: tuple[str, ...] = ()
    metavar: str = ""
    ui: Mapping[str, Any] = field(default_factory=dict)

    def field(self) -> Any:
        """Return a field for the class of a dataclass."""
        return field(default=self.default, metadata={"setting": self})

    @property
    def option(self) -> str:
        return f"--{self.name.replace('_', '-')}"

    @property
    def kind(self) -> type:
        """Return the type of a value, or of the elements of a list."""
        return type(self.default[0] if isinstance(self.default, tuple) else self.default)

    def is_valid(self, value: object) -> bool:
        """Return whether a value is one of the choices, or between the limits."""
        if self.kind in (str, bool):
            return isinstance(value, self.kind) and (not self.choices or value in (*self.choices, self.default))
        values = value if isinstance(self.default, tuple) else (value,)
        return bool(values) and all(self.low <= number <= self.high for number in values)

    def add_option(self, parser: argparse._ActionsContainer, **arguments: Any) -> None:
        """Add the option to a parser, with arguments of `add_argument` that differ."""
        text = self.description[0].lower() + self.description[1:].replace("%", "%%")
        if isinstance(self.default, bool):
            parser.add_argument(self.option, action="store_true", help=text)
            return
        is_list = isinstance(self.default, tuple)
        shown_default = " ".join(map(str, self.default)) if is_list else self.default
        defaults = {
            "type": self._parse,
            "default": self.default,
            "nargs": "+" if is_list else None,
            "choices": self.choices or None,
            "metavar": self.metavar or {int: "N", float: "X"}.get(self.kind),
            "help": text if shown_default == "" else f"{text} (default {shown_default})",
        }
        parser.add_argument(self.option, **(defaults | arguments))

    def _parse(self, text: str) -> Any:
        try:
            value = self.kind(text)
            if self.kind is str or (self.low <= value <= self.high):
                return value
        except ValueError:
            pass
        limits = ["more than 0" if self.low == ABOVE_ZERO else f"{self.low:g} or more"]
        limits += [f"at most {self.high:g}"] if self.high < sys.float_info.max else []
        number = "a whole number" if self.kind is int else "a number"
        raise argparse.ArgumentTypeError(f"must be {number}, {' and '.join(limits)}, not '{text}'")


def settings_of(settings_class: type) -> list[Setting]:
    """Return the settings among the fields of a dataclass."""
    return [f.metadata["setting"] for f in fields(settings_class) if "setting" in f.metadata]


def values_from(owner: object, settings: list[Setting]) -> dict[str, Any]:
    """Read settings from the attributes of an object, such as parsed options or Blender's properties."""
    values = {setting.name: getattr(owner, setting.name) for setting in settings}
    # Round a float32 property to the number that the user typed.
    return {
        name: float(f"{value:.6g}") if isinstance(value, float) and math.isfinite(value) else value
        for name, value in values.items()
    }


POSES = Setting("poses", 1000, "Number of random poses to record", "Random Poses", ui={"soft_max": 10000})
MAX_AUTO_POSES = 5000
AUTO_POSES = Setting(
    "auto_poses",
    False,
    f"Record as many random poses as this computer evaluates in about a minute, {POSES.default:,} to "
    f"{MAX_AUTO_POSES:,}",
    "Auto",
    ui={"default": True},
)
SEED = Setting("seed", 0, "Random seed of the poses", "Seed")
SPREAD = Setting(
    "spread",
    1.0,
    "How far random poses spread over the limits: small values stay near the middle, large values fill the range "
    "evenly. An elbow with limits from 0° to 140° mostly bends between 35° and 105° at 0.5; at 10 all angles are "
    "equally frequent",
    "Spread",
    ABOVE_ZERO,
    10,
    ui={"min": 0.05, "step": 10},
)
"""Standard deviation of random poses, as a ratio of half the range of motion."""
OVERSHOOT = Setting(
    "overshoot",
    1.0,
    "Take a quarter of the random poses from limits that are wider by this factor, and rotate locked axes too, so that "
    "the model stays accurate beyond the limits. 1 to stay within the limits",
    "Overshoot",
    1,
    4,
    metavar="F",
    ui={"step": 10},
)
"""Factor by which the range of motion is scaled for overshoot poses (`poses.Overshoot`); 1 for no overshoot."""
MIRROR = Setting(
    "mirror",
    False,
    "Record each frame of the actions a second time with left and right swapped. The armature must be symmetric",
    "Also Record Mirrored",
)
LEARN_FROM = Setting(
    "learn_from",
    "",
    "Learn the shape of another mesh object with the same vertices, for example a simulated or cached copy. Empty to "
    "learn from the rig itself",
    "Learn from Object",
    metavar="OBJECT",
)
PRE_ROLL = Setting(
    "pre_roll",
    0,
    "Frames before an action in which a simulation moves from the rest pose to the first frame",
    "Pre-Roll",
    ui={"soft_max": 100},
)
SETTLE_FRAMES = Setting(
    "settle_frames",
    0,
    "Maximum number of frames to hold each random pose until the simulation comes to rest. 0 to record no random poses",
    "Settle",
    ui={"soft_max": 200},
)
REST_THRESHOLD_MM = Setting(
    "rest_threshold_mm", 0.1, "A simulation is at rest if no vertex moves by more mm in a frame", low=ABOVE_ZERO
)
REFINEMENT_POSES = 250
"""Number of poses that a refinement adds where the error of a model is largest."""

TRAINING_SEED = Setting("seed", 0, "Random seed of the training", "Seed", high=(1 << 63) - 1)
"""PyTorch takes no larger seeds."""
MAX_DETAIL_MM = 0.04
"""The largest detail that is chosen automatically."""
DETAIL_MM = Setting(
    "detail_mm",
    0.0,
    "Smallest deformation worth learning, in mm; smaller is more accurate and slower. 0.05 is invisible in a close-up "
    f"of a face, 0.5 in a full figure. 0 chooses {MAX_DETAIL_MM} or 1 % of the error of skinning alone, whichever is "
    "less",
    "Detail (mm)",
    ui={"soft_max": 1.0, "precision": 3, "step": 1},
)
"""Allowed rms error of the principal components alone, over training poses and all vertices, mm."""
PASSES = Setting(
    "passes",
    0,
    "How often to train on every recorded pose; more is more accurate and takes longer. 0 chooses 200 for up to 1,000 "
    "poses, and fewer for more: 120 for 4,000",
    "Training Passes",
    ui={"soft_max": 1000},
)


def automatic_passes(poses: int) -> int:
    """Return the passes of a training on a recording, where the setting is 0.

    Of twice as many poses each needs fewer passes; the training takes 1.5 times as long.
    """
    return round(200 * (1000 / max(poses, 1000)) ** 0.37)


GOAL_MM = Setting(
    "goal_mm",
    0.0,
    "Error that 99.9 % of the vertices in unseen poses shall stay below, in mm; 0 for no goal",
    "Goal (mm)",
    ui={"default": 0.5, "min": 0.001, "soft_max": 10.0, "precision": 2, "step": 10},
)
MIN_VERTICES_PER_PART = Setting(
    "min_vertices_per_part",
    8,
    "Merge body parts with fewer vertices into a neighbor: a tongue of 5 vertices becomes part of the jaw. 0 to merge "
    "none",
    "Min Vertices per Part",
    ui={"soft_max": 100},
)

EVALUATION_POSES, SIDEBAR_EVALUATION_POSES = 200, 100
"""Numbers of random poses in which a model is compared with its rig; fewer in the sidebar, where the user waits."""
EVALUATION_SEED = 1
"""Seed of the poses of an evaluation; it differs from the default seed of a recording."""
FILM_TIMED_FRAMES = 50
"""Number of frames that are timed for the frame times in a film."""

ALL, AUTO = "all", "auto"
"""Values of the setting `bones_to_read`, the joints that a model reads, besides a number of joints."""


def parse_joints(text: str) -> str:
    """Check the value of `bones_to_read`, "all", "auto" or a number from 1, and return it.

    Raises:
        ValueError: the text is something else. The message is a clause about the value.
    """
    if text not in (ALL, AUTO) and not (text.isascii() and text.isdecimal() and 1 <= int(text) <= 100_000):
        raise ValueError(f"joints are {AUTO}, {ALL}, or a number from 1, and not {text!r}")
    return text if text in (ALL, AUTO) else str(int(text))
