# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings of a training, their checks and their command-line options."""

import argparse
import math
from dataclasses import asdict, dataclass, fields

from fdda_addon.core.defaults import EPOCHS, TOLERANCE_MM
from fdda_addon.core.errors import TrainingError

ACTIVATIONS = ("silu", "gelu", "tanh", "relu")


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of a training; docs/experiments.md has the measurements behind the defaults.

    Attributes:
        seed: seed of the split, the initial weights and the order of the poses.
        tolerance_mm: rms error over training poses and all vertices that the components may leave, mm.
        hidden: units of each hidden layer of a network.
        activation: activation of the hidden layers, one of `ACTIVATIONS`.
        epochs: passes over the training poses.
        batch_size: poses per step.
        learning_rate: maximum of the one-cycle schedule.
        weight_decay: decoupled weight decay of AdamW.
        validation_fraction: part of the poses that select the best weights; the networks are not trained on them.
        held_out_fraction: part of the poses that measure the error, and are used for nothing else.
        goal_mm: distance that 99.9 % of the held-out vertices should not exceed, mm; 0 for no goal.
        include_unsettled: also use poses in which the target did not come to rest.
    """

    seed: int = 0
    tolerance_mm: float = TOLERANCE_MM
    hidden: tuple[int, ...] = (64, 64)
    activation: str = "silu"
    epochs: int = EPOCHS
    batch_size: int = 64
    learning_rate: float = 1e-2
    weight_decay: float = 0.2
    validation_fraction: float = 0.05
    held_out_fraction: float = 0.1
    goal_mm: float = 0.0
    include_unsettled: bool = False

    def __post_init__(self):
        checks = {
            "seed": self.seed >= 0,
            "tolerance_mm": self.tolerance_mm > 0,
            "hidden": len(self.hidden) > 0 and all(1 <= units <= 4096 for units in self.hidden),
            "activation": self.activation in ACTIVATIONS,
            "epochs": self.epochs >= 1,
            "batch_size": self.batch_size >= 1,
            "learning_rate": self.learning_rate > 0,
            "weight_decay": self.weight_decay >= 0,
            "validation_fraction": 0 < self.validation_fraction <= 0.4,
            "held_out_fraction": 0 < self.held_out_fraction <= 0.4,
            "goal_mm": self.goal_mm >= 0,
            "include_unsettled": isinstance(self.include_unsettled, bool),
        }
        for name, is_valid in checks.items():
            value = getattr(self, name)
            if not is_valid or (isinstance(value, float) and not math.isfinite(value)):
                raise TrainingError(f"The training setting {name} cannot be {value!r}; see python -m trainer --help.")

    @staticmethod
    def from_mapping(values: dict) -> "TrainingConfig":
        """Create settings from names and values; missing settings have their defaults.

        Raises:
            TrainingError: a name is unknown or a value is impossible.
        """
        names = {field.name for field in fields(TrainingConfig)}
        if unknown := sorted(set(values) - names):
            raise TrainingError(
                f"Unknown training {'setting' if len(unknown) == 1 else 'settings'} {', '.join(unknown)}; "
                f"known are {', '.join(sorted(names))}."
            )
        values = dict(values)
        if "hidden" in values:
            values["hidden"] = tuple(values["hidden"])
        return TrainingConfig(**values)

    def to_json(self) -> dict:
        """Convert to JSON."""
        return {**asdict(self), "hidden": list(self.hidden)}


OPTION_HELP = {
    "seed": "of the split, the initial weights and the order of the poses",
    "tolerance_mm": "rms error that the components may leave over the whole mesh, in mm",
    "hidden": "units of each hidden layer",
    "activation": "of the hidden layers",
    "epochs": "passes over the training poses",
    "batch_size": "poses per step",
    "learning_rate": "maximum of the one-cycle schedule",
    "weight_decay": "of AdamW",
    "validation_fraction": "part of the poses that selects the best weights and does not train",
    "held_out_fraction": "part of the poses that measures the error, and neither trains nor selects weights",
    "goal_mm": "distance that 99.9 %% of the held-out vertices should not exceed, in mm; 0 for no goal",
    "include_unsettled": "also use poses in which the target did not come to rest",
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add an option for each setting to a parser, for example `--batch-size` for `batch_size`."""
    group = parser.add_argument_group("training settings")
    for field in fields(TrainingConfig):
        if isinstance(field.default, bool):
            group.add_argument(f"--{field.name.replace('_', '-')}", action="store_true", help=OPTION_HELP[field.name])
            continue
        kind = {"hidden": int, "activation": str}.get(field.name, type(field.default))
        default = " ".join(map(str, field.default)) if field.name == "hidden" else field.default
        group.add_argument(
            f"--{field.name.replace('_', '-')}",
            type=kind,
            default=field.default,
            nargs="+" if field.name == "hidden" else None,
            choices=ACTIVATIONS if field.name == "activation" else None,
            metavar=None if field.name == "activation" else "N" if kind is int else "X",
            help=f"{OPTION_HELP[field.name]} (default: {default})",
        )


def config_from_arguments(arguments: argparse.Namespace) -> TrainingConfig:
    """Create settings from the options that `add_options` added.

    Raises:
        TrainingError: a value is impossible.
    """
    return TrainingConfig.from_mapping({f.name: getattr(arguments, f.name) for f in fields(TrainingConfig)})
