# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings of a training, their checks and their command-line options."""

import argparse
from dataclasses import asdict, dataclass

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.mathematics.partition import INFLUENCE_TOLERANCE
from fdda_addon.core.mathematics.skin_fit import FIT_KINDS
from fdda_addon.core.settings import (
    ABOVE_ZERO,
    ALL,
    DETAIL_MM,
    GOAL_MM,
    MIN_VERTICES_PER_PART,
    PASSES,
    TRAINING_SEED,
    Setting,
    parse_joints,
    settings_of,
)

HIDDEN = Setting("hidden", (64, 64), "Units of each hidden layer", low=1, high=4096)
ACTIVATION = Setting("activation", "silu", "Of the hidden layers", choices=("silu", "gelu", "tanh", "relu"))
BATCH_SIZE = Setting("batch_size", 64, "Poses per step", low=1)
LEARNING_RATE = Setting("learning_rate", 1e-2, "Maximum of the one-cycle schedule", low=ABOVE_ZERO)
WEIGHT_DECAY = Setting("weight_decay", 0.2, "Of AdamW")
VALIDATION_FRACTION = Setting(
    "validation_fraction",
    0.05,
    "Part of the poses that selects the best weights and does not train",
    low=ABOVE_ZERO,
    high=0.4,
)
HELD_OUT_FRACTION = Setting(
    "held_out_fraction",
    0.1,
    "Part of the poses that measures the error, and neither trains nor selects weights",
    low=ABOVE_ZERO,
    high=0.4,
)
INCLUDE_UNSETTLED = Setting("include_unsettled", False, "Also use poses in which the target did not come to rest")
BASE_SKINNING = Setting(
    "base_skinning",
    "",
    "Skin weights to fit: hard for one joint per vertex, smooth for at most four; the rig's own if left out",
    choices=FIT_KINDS,
)
BONES_TO_READ = Setting("bones_to_read", ALL, "Joints that the model reads: auto for the fewest, all, or their number")
INFLUENCE = Setting(
    "influence_tolerance",
    INFLUENCE_TOLERANCE,
    "An input influences a partition when it changes residuals by more, in character sizes",
)


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of a training; docs/experiments.md has the measurements behind the defaults.

    Raises:
        TrainingError: a value is impossible.
    """

    seed: int = TRAINING_SEED.field()
    detail_mm: float = DETAIL_MM.field()
    hidden: tuple[int, ...] = HIDDEN.field()
    activation: str = ACTIVATION.field()
    passes: int = PASSES.field()
    batch_size: int = BATCH_SIZE.field()
    learning_rate: float = LEARNING_RATE.field()
    weight_decay: float = WEIGHT_DECAY.field()
    validation_fraction: float = VALIDATION_FRACTION.field()
    held_out_fraction: float = HELD_OUT_FRACTION.field()
    goal_mm: float = GOAL_MM.field()
    include_unsettled: bool = INCLUDE_UNSETTLED.field()
    base_skinning: str = BASE_SKINNING.field()
    bones_to_read: str = BONES_TO_READ.field()
    min_vertices_per_part: int = MIN_VERTICES_PER_PART.field()
    influence_tolerance: float = INFLUENCE.field()

    def __post_init__(self):
        for setting in settings_of(TrainingConfig):
            value = getattr(self, setting.name)
            if not (_is_joints_option(value) if setting is BONES_TO_READ else setting.is_valid(value)):
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


def _parse_joints_option(text: str) -> str:
    try:
        return parse_joints(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add an option for each setting to a parser, for example `--batch-size` for `batch_size`."""
    group = parser.add_argument_group("training settings")
    for setting in settings_of(TrainingConfig):
        setting.add_option(group, **({"type": _parse_joints_option} if setting is BONES_TO_READ else {}))


def config_from_arguments(arguments: argparse.Namespace) -> TrainingConfig:
    """Create settings from the options that `add_options` added."""
    values = {setting.name: getattr(arguments, setting.name) for setting in settings_of(TrainingConfig)}
    return TrainingConfig(**{**values, "hidden": tuple(values["hidden"])})
