# SPDX-License-Identifier: GPL-3.0-or-later
"""The learning curves of a training."""

from dataclasses import dataclass, field


@dataclass
class Curves:
    """Errors of one partition after each epoch: rms distances over the vertices, mm.

    Attributes:
        training_mm: mean over the training poses.
        validation_mm: mean over the validation poses.
        worst_mm: maximum over the validation poses.
        best_epoch: epoch with the lowest `validation_mm`; epoch 1 is the first.
    """

    training_mm: list[float] = field(default_factory=list)
    validation_mm: list[float] = field(default_factory=list)
    worst_mm: list[float] = field(default_factory=list)
    best_epoch: int = 0
