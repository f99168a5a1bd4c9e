# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings of a training, their checks and their command-line options."""

import argparse
import sys
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from fdda_addon.core.defaults import EPOCHS, MIN_PARTITION_VERTICES, TOLERANCE_MM
from fdda_addon.core.errors import TrainingError
from fdda_addon.core.joint_option import ALL, parse_joints
from fdda_addon.core.mathematics.partition import INFLUENCE_TOLERANCE
from fdda_addon.core.mathematics.skin_fit import FIT_KINDS

ACTIVATIONS = ("silu", "gelu", "tanh", "relu")
CHOICES = {"activation": ACTIVATIONS, "fit_linear": ("", *FIT_KINDS)}
"""Values of settings that are texts; "" is the default, which no option gives."""
MAX_SEED = (1 << 63) - 1
"""torch takes no larger seeds."""
ABOVE_ZERO, LARGEST = sys.float_info.min, sys.float_info.max


def _setting(default: Any, help_text: str, low: float = 0, high: float = LARGEST) -> Any:
    return field(default=default, metadata={"help": help_text, "low": low, "high": high})


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of a training; docs/experiments.md has the measurements behind the defaults.

    Raises:
        TrainingError: a value is impossible.
    """

    seed: int = _setting(0, "of the split, the initial weights and the order of the poses", high=MAX_SEED)
    tolerance_mm: float = _setting(
        TOLERANCE_MM, "rms error that the components may leave over the whole mesh, in mm", ABOVE_ZERO
    )
    hidden: tuple[int, ...] = _setting((64, 64), "units of each hidden layer", 1, 4096)
    activation: str = _setting("silu", "of the hidden layers")
    epochs: int = _setting(EPOCHS, "passes over the training poses", 1)
    batch_size: int = _setting(64, "poses per step", 1)
    learning_rate: float = _setting(1e-2, "maximum of the one-cycle schedule", ABOVE_ZERO)
    weight_decay: float = _setting(0.2, "of AdamW", 0)
    validation_fraction: float = _setting(
        0.05, "part of the poses that selects the best weights and does not train", ABOVE_ZERO, 0.4
    )
    held_out_fraction: float = _setting(
        0.1, "part of the poses that measures the error, and neither trains nor selects weights", ABOVE_ZERO, 0.4
    )
    goal_mm: float = _setting(
        0.0, "distance that 99.9 %% of the held-out vertices should not exceed, in mm; 0 for no goal", 0
    )
    include_unsettled: bool = _setting(False, "also use poses in which the target did not come to rest")
    fit_linear: str = _setting(
        "", "skin weights to fit: hard for one joint per vertex, smooth for at most four; the rig's own if left out"
    )
    joints: str = _setting(ALL, "joints that the model reads: auto for the fewest, all, or their number")
    min_partition_vertices: int = _setting(
        MIN_PARTITION_VERTICES, "merge partitions with fewer vertices into others; 0 to merge none"
    )
    influence_tolerance: float = _setting(
        INFLUENCE_TOLERANCE, "an input influences a partition when it changes residuals by more, in character sizes"
    )

    def __post_init__(self):
        for setting in fields(self):
            value, limits = getattr(self, setting.name), setting.metadata
            if setting.name == "joints":
                is_valid = _is_joints_option(value)
            elif isinstance(setting.default, str | bool):
                is_valid = value in CHOICES.get(setting.name, (False, True))
            else:
                values = value if isinstance(value, tuple) else (value,)
                is_valid = values and all(limits["low"] <= number <= limits["high"] for number in values)
            if not is_valid:
                raise TrainingError(
                    f"The training setting {setting.name} cannot be {value!r}; see python -m trainer --help."
                )

    def to_json(self) -> dict:
        """Convert to JSON."""
        return {**asdict(self), "hidden": list(self.hidden)}


def _is_joints_option(text: str) -> bool:
    try:
        return parse_joints(text) == text
    except ValueError:
        return False


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add an option for each setting to a parser, for example `--batch-size` for `batch_size`."""
    group = parser.add_argument_group("training settings")
    for setting in fields(TrainingConfig):
        name, default, help_text = f"--{setting.name.replace('_', '-')}", setting.default, setting.metadata["help"]
        if isinstance(default, bool):
            group.add_argument(name, action="store_true", help=help_text)
            continue
        is_list = isinstance(default, tuple)
        kind = parse_joints if setting.name == "joints" else type(default[0] if is_list else default)
        group.add_argument(
            name,
            type=kind,
            default=default,
            nargs="+" if is_list else None,
            choices=[choice for choice in CHOICES.get(setting.name, ()) if choice] or None,
            metavar={int: "N", float: "X"}.get(kind),
            help=help_text
            + (f" (default: {' '.join(map(str, default)) if is_list else default})" if default != "" else ""),
        )


def config_from_arguments(arguments: argparse.Namespace) -> TrainingConfig:
    """Create settings from the options that `add_options` added.

    Raises:
        TrainingError: a value is impossible.
    """
    values = {setting.name: getattr(arguments, setting.name) for setting in fields(TrainingConfig)}
    return TrainingConfig(**{**values, "hidden": tuple(values["hidden"])})
