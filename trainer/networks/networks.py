# SPDX-License-Identifier: GPL-3.0-or-later
"""The networks of partitions, alone and as one batched network."""

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Self

import numpy as np
import torch
from torch.nn import functional

from ..preparation import PreparedPartition

ACTIVATION_FUNCTIONS = {"silu": functional.silu, "gelu": functional.gelu, "tanh": torch.tanh, "relu": torch.relu}


@dataclass(frozen=True)
class Network:
    """The trained network of one partition, in numpy.

    Attributes:
        weights: one (in, out) float32 array per layer, from standardized features to coefficients in mesh units.
        biases: one (out,) float32 array per layer.
        activation: as in `TrainingConfig`.
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    activation: str

    @classmethod
    def without_outputs(cls, input_count: int, activation: str) -> Self:
        """Return the network of a partition without components. It has one layer."""
        return cls((np.zeros((input_count, 0), np.float32),), (np.zeros(0, np.float32),), activation)

    def evaluate(self, inputs: np.ndarray) -> np.ndarray:
        """Compute (N, K) float32 coefficients, mesh units, of (N, F) float32 standardized features, in PyTorch."""
        values = torch.from_numpy(inputs)
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = torch.addmm(torch.from_numpy(bias), values, torch.from_numpy(weight))
            if layer < len(self.weights) - 1:
                values = ACTIVATION_FUNCTIONS[self.activation](values)
        return values.numpy()


@dataclass
class Curves:
    """Errors of one partition after each epoch: rms distances over the vertices, mm.

    Attributes:
        training_mm: mean over the training poses.
        validation_mm: mean over the validation poses.
        worst_mm: maximum over the validation poses.
    """

    training_mm: list[float] = field(default_factory=list)
    validation_mm: list[float] = field(default_factory=list)
    worst_mm: list[float] = field(default_factory=list)

    @property
    def best_epoch(self) -> int:
        """The epoch with the lowest `validation_mm`; epoch 1 is the first, 0 means none."""
        return 1 + int(np.argmin(self.validation_mm)) if self.validation_mm else 0


@dataclass(frozen=True, kw_only=True)
class TrainedPartition(PreparedPartition):
    """A partition with its network and the curves of its training."""

    network: Network
    curves: Curves


class PartitionNetworks(torch.nn.Module):
    """P networks of equal hidden sizes, evaluated together.

    Inputs and outputs are padded to the widest partition. Weights of padding start at zero; their inputs and targets
    are zero too, so they get no gradient.

    Attributes:
        weights: one tensor (P, in, out) per layer.
        biases: one tensor (P, 1, out) per layer.
    """

    def __init__(
        self,
        input_counts: list[int],
        output_counts: list[int],
        hidden: tuple[int, ...],
        activation: str,
        generator: torch.Generator,
    ):
        """Draw the initial weights.

        Args:
            input_counts, output_counts: numbers of features and of components of the P partitions.
            hidden, activation: as in `TrainingConfig`.
        """
        super().__init__()
        self.activation = ACTIVATION_FUNCTIONS[activation]
        sizes = [max(input_counts), *hidden, max(output_counts)]
        weights, biases = [], []
        for layer, (fan_in, fan_out) in enumerate(pairwise(sizes)):
            weight = torch.zeros(len(input_counts), fan_in, fan_out)
            for index, (input_count, output_count) in enumerate(zip(input_counts, output_counts, strict=True)):
                rows = input_count if layer == 0 else fan_in
                columns = output_count if layer == len(hidden) else fan_out
                # Half the usual standard deviation in the output layer: training starts near the mean residual.
                gain = 0.5 if layer == len(hidden) else 1.0
                values = torch.randn(rows, columns, generator=generator)
                weight[index, :rows, :columns] = values * gain / math.sqrt(max(rows, 1))
            weights.append(torch.nn.Parameter(weight))
            biases.append(torch.nn.Parameter(torch.zeros(len(input_counts), 1, fan_out)))
        self.weights = torch.nn.ParameterList(weights)
        self.biases = torch.nn.ParameterList(biases)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Compute (P, n, K) coefficients, in units of each partition's residual, of (P, n, F) features; both padded."""
        values = inputs
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = torch.baddbmm(bias, values, weight)
            if layer < len(self.weights) - 1:
                values = self.activation(values)
        return values
