# SPDX-License-Identifier: GPL-3.0-or-later
"""The networks of all partitions as one batched network."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch.nn import functional

ACTIVATIONS = {
    "silu": functional.silu,
    "gelu": functional.gelu,
    "tanh": torch.tanh,
    "relu": torch.relu,
}


@dataclass(frozen=True)
class Network:
    """The trained network of one partition, in numpy.

    Attributes:
        weights: one (in, out) float32 a layer; standardized features in, coefficients in mesh units out.
        biases: one (out,) float32 a layer.
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]

    def coefficients(self, inputs: np.ndarray, activation: str) -> np.ndarray:
        """(N, F) float32 standardized features to (N, K) float32 coefficients, mesh units, in PyTorch."""
        values = torch.from_numpy(inputs)
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = torch.addmm(torch.from_numpy(bias), values, torch.from_numpy(weight))
            if layer < len(self.weights) - 1:
                values = ACTIVATIONS[activation](values)
        return values.numpy()


class PartitionNetworks(torch.nn.Module):
    """P networks of equal hidden sizes, evaluated together.

    Inputs and outputs are padded to the widest partition. The weights of padding start at zero, and as its inputs
    and targets are zero too, no gradient ever moves them.

    Attributes:
        weights: tensors (P, in, out), one a layer.
        biases: tensors (P, 1, out), one a layer.
    """

    def __init__(
        self,
        inputs: list[int],
        outputs: list[int],
        hidden: tuple[int, ...],
        activation: str,
        dropout: float,
        generator: torch.Generator,
    ):
        """Draw the initial weights.

        Args:
            inputs, outputs: features and basis shapes of each of the P partitions.
            hidden, activation, dropout: as in `TrainingConfig`.
            generator: of the initial weights.
        """
        super().__init__()
        self.activation = ACTIVATIONS[activation]
        self.dropout = dropout
        sizes = [max(inputs), *hidden, max(outputs)]
        weights, biases = [], []
        for layer, (fan_in, fan_out) in enumerate(pairwise(sizes)):
            weight = torch.zeros(len(inputs), fan_in, fan_out)
            for number, (used_in, used_out) in enumerate(zip(inputs, outputs, strict=True)):
                rows = used_in if layer == 0 else fan_in
                columns = used_out if layer == len(hidden) else fan_out
                # Half the output layer's usual variance: the networks start close to the mean residual.
                gain = 0.5 if layer == len(hidden) else 1.0
                values = torch.randn(rows, columns, generator=generator)
                weight[number, :rows, :columns] = values * gain / math.sqrt(max(rows, 1))
            weights.append(torch.nn.Parameter(weight))
            biases.append(torch.nn.Parameter(torch.zeros(len(inputs), 1, fan_out)))
        self.weights = torch.nn.ParameterList(weights)
        self.biases = torch.nn.ParameterList(biases)

    def forward(self, inputs: torch.Tensor, generator: torch.Generator | None = None) -> torch.Tensor:
        """Evaluate.

        Args:
            inputs: (P, n, F) standardized features, padded.
            generator: drops hidden units at random when given; none evaluates without dropout.

        Returns:
            (P, n, K) coefficients, in the partition's own scale, padded.
        """
        values = inputs
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = torch.baddbmm(bias, values, weight)
            if layer < last:
                values = self.activation(values)
                if generator is not None and self.dropout > 0:
                    kept = torch.rand(values.shape, generator=generator, device=values.device) >= self.dropout
                    values = values * kept / (1 - self.dropout)
        return values
