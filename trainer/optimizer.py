# SPDX-License-Identifier: GPL-3.0-or-later
"""AdamW on a one-cycle schedule, without `torch.optim`.

The first step of an optimizer of `torch.optim` imports PyTorch's compiler, which takes longer than `import torch` and
is of no use here. These are the same numbers as those of `torch.optim.AdamW(fused=True)` with `OneCycleLR`.
"""

import math
from collections.abc import Iterable

import torch

BETA_2 = 0.999
EPSILON = 1e-8
MIN_BETA_1, MAX_BETA_1 = 0.85, 0.95
"""Beta 1 falls while the learning rate rises, and the other way round."""
INITIAL_RATE_DIVISOR = 25.0
FINAL_RATE_DIVISOR = 25.0 * 1e4


class OneCycleAdamW:
    """AdamW whose learning rate rises to its largest value and falls to almost zero, along halves of a cosine.

    References:
        Loshchilov and Hutter, Decoupled Weight Decay Regularization, 2019; Smith and Topin, Super-Convergence, 2018.
    """

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        learning_rate: float,
        weight_decay: float,
        total_steps: int,
        warm_up: float,
    ):
        """Start before the first step.

        Args:
            parameters: all of them have a gradient at each step.
            learning_rate: the largest.
            weight_decay: relative to the learning rate.
            total_steps: the length of the cycle.
            warm_up: share of the steps in which the learning rate rises.
        """
        self._parameters = list(parameters)
        self._learning_rate, self._weight_decay = learning_rate, weight_decay
        self._total_steps, self._warm_up = total_steps, warm_up
        self._means = [torch.zeros_like(parameter) for parameter in self._parameters]
        self._mean_squares = [torch.zeros_like(parameter) for parameter in self._parameters]
        self._step_counts = [torch.zeros((), device=parameter.device) for parameter in self._parameters]
        self._step = 0

    def zero_grad(self) -> None:
        """Drop the gradients."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Move the parameters by their gradients."""
        learning_rate, beta_1 = self.schedule(self._step)
        self._step += 1
        torch._foreach_add_(self._step_counts, 1)
        torch._fused_adamw_(
            self._parameters,
            [parameter.grad for parameter in self._parameters],
            self._means,
            self._mean_squares,
            [],
            self._step_counts,
            lr=learning_rate,
            beta1=beta_1,
            beta2=BETA_2,
            weight_decay=self._weight_decay,
            eps=EPSILON,
            amsgrad=False,
            maximize=False,
        )

    def schedule(self, step: int) -> tuple[float, float]:
        """Return the learning rate and beta 1 of a step; 0 is the first."""
        peak, end = self._warm_up * self._total_steps - 1, self._total_steps - 1
        initial_rate = self._learning_rate / INITIAL_RATE_DIVISOR
        final_rate = self._learning_rate / FINAL_RATE_DIVISOR
        if step <= peak:
            fraction = step / peak
            rates, betas = (initial_rate, self._learning_rate), (MAX_BETA_1, MIN_BETA_1)
        else:
            fraction = (step - peak) / (end - peak)
            rates, betas = (self._learning_rate, final_rate), (MIN_BETA_1, MAX_BETA_1)
        return _along_cosine(*rates, fraction), _along_cosine(*betas, fraction)


def _along_cosine(start: float, end: float, fraction: float) -> float:
    return end + (start - end) / 2.0 * (1 + math.cos(math.pi * fraction))
