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
        seed: of the split, the initial weights, the order of the poses and the dropout.
        tolerance_mm: there are as many basis shapes as it takes to bring the rms error of the training residuals, over
            poses and all vertices, to this.
        hidden: units of each hidden layer of a partition's network.
        activation: between the layers, one of `ACTIVATIONS`.
        epochs: passes over the training poses.
        batch_size: poses a step.
        learning_rate: highest of the one-cycle schedule.
        weight_decay: of AdamW, decoupled.
        dropout: part of the hidden units that is dropped in a step.
        l1, l2: factors of the sums of absolute and squared weights in the loss.
        averaging: part of the average of the weights that one step replaces is 1 - averaging; 0 takes the weights
            themselves.
        validation_fraction: part of the poses that is kept from the training to choose the best weights.
        held_out_fraction: part of the poses that is kept from training and choice to measure the error on.
        goal_mm: what 99.9 % of the held-out vertices are to be within, 0 for no goal.
        patience: stop when no partition has improved for so many epochs; 0 trains to the end.
        include_unsettled: use poses in which the target did not come to rest as well.
    """

    seed: int = 0
    tolerance_mm: float = TOLERANCE_MM
    hidden: tuple[int, ...] = (64, 64)
    activation: str = "silu"
    epochs: int = EPOCHS
    batch_size: int = 64
    learning_rate: float = 1e-2
    weight_decay: float = 0.2
    dropout: float = 0.0
    l1: float = 0.0
    l2: float = 0.0
    averaging: float = 0.99
    validation_fraction: float = 0.05
    held_out_fraction: float = 0.1
    goal_mm: float = 0.0
    patience: int = 0
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
            "dropout": 0 <= self.dropout < 1,
            "l1": self.l1 >= 0,
            "l2": self.l2 >= 0,
            "averaging": 0 <= self.averaging < 1,
            "validation_fraction": 0 < self.validation_fraction <= 0.4,
            "held_out_fraction": 0 < self.held_out_fraction <= 0.4,
            "goal_mm": self.goal_mm >= 0,
            "patience": self.patience >= 0,
            "include_unsettled": isinstance(self.include_unsettled, bool),
        }
        for name, good in checks.items():
            value = getattr(self, name)
            if not good or (isinstance(value, float) and not math.isfinite(value)):
                raise TrainingError(f"The training setting {name} cannot be {value!r}; see python -m trainer --help.")

    @staticmethod
    def from_mapping(values: dict) -> "TrainingConfig":
        """Make settings from names and values; what is left out keeps its default.

        Raises:
            TrainingError: a name is unknown or a value is impossible.
        """
        known = {field.name for field in fields(TrainingConfig)}
        if unknown := sorted(set(values) - known):
            raise TrainingError(
                f"Unknown training {'setting' if len(unknown) == 1 else 'settings'} {', '.join(unknown)}; "
                f"known are {', '.join(sorted(known))}."
            )
        values = dict(values)
        if "hidden" in values:
            values["hidden"] = tuple(values["hidden"])
        return TrainingConfig(**values)

    def to_json(self) -> dict:
        return {**asdict(self), "hidden": list(self.hidden)}


HELP = {
    "seed": "of the split, the initial weights and the order of the poses",
    "tolerance_mm": "rms error that the basis shapes may leave over the whole mesh, in mm",
    "hidden": "units of each hidden layer",
    "activation": "between the layers",
    "epochs": "passes over the training poses",
    "batch_size": "poses a step",
    "learning_rate": "highest of the one-cycle schedule",
    "weight_decay": "of AdamW",
    "dropout": "part of the hidden units that is dropped in a step",
    "l1": "factor of the sum of absolute weights in the loss",
    "l2": "factor of the sum of squared weights in the loss",
    "averaging": "how slowly the average of the weights moves, 0 for no average",
    "validation_fraction": "part of the poses that is kept from the training to choose the best weights",
    "held_out_fraction": "part of the poses that is kept from all of it to measure the error on",
    "goal_mm": "what 99.9 %% of the held-out vertices are to be within, in mm; 0 for no goal",
    "patience": "stop after so many epochs without improvement, 0 for never",
    "include_unsettled": "use the poses in which the target did not come to rest as well",
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Give a parser one option for each setting, `--batch-size` for `batch_size`."""
    group = parser.add_argument_group("training settings")
    for field in fields(TrainingConfig):
        if isinstance(field.default, bool):
            group.add_argument(f"--{field.name.replace('_', '-')}", action="store_true", help=HELP[field.name])
            continue
        kind = {"hidden": int, "activation": str}.get(field.name, type(field.default))
        shown = " ".join(map(str, field.default)) if field.name == "hidden" else field.default
        group.add_argument(
            f"--{field.name.replace('_', '-')}",
            type=kind,
            default=field.default,
            nargs="+" if field.name == "hidden" else None,
            choices=ACTIVATIONS if field.name == "activation" else None,
            metavar=None if field.name == "activation" else "N" if kind is int else "X",
            help=f"{HELP[field.name]} (default: {shown})",
        )


def config_from_arguments(arguments: argparse.Namespace) -> TrainingConfig:
    """Settings from the options that `add_options` made.

    Raises:
        TrainingError: a value is impossible.
    """
    return TrainingConfig.from_mapping({f.name: getattr(arguments, f.name) for f in fields(TrainingConfig)})
