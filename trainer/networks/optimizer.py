# SPDX-License-Identifier: GPL-3.0-or-later
"""AdamW on a one-cycle schedule, without `torch.optim`.

The first step of an optimizer of `torch.optim` imports PyTorch's compiler, which a training does not need. This class
computes the same numbers as `torch.optim.AdamW(fused=True)` with `OneCycleLR`.
"""

import math
from collections.abc import Iterable

import torch

BETA_2 = 0.999
EPSILON = 1e-8
MIN_BETA_1, MAX_BETA_1 = 0.85, 0.95
"""Limits of beta 1, which falls while the learning rate rises, and rises while it falls."""
INITIAL_RATE_DIVISOR = 25.0
FINAL_RATE_DIVISOR = 25.0 * 1e4


class OneCycleAdamW:
    """The optimizer AdamW with a learning rate that rises to its maximum and falls to almost zero.

    Both parts of the cycle follow half a period of a cosine.

    References:
        Loshchilov and Hutter, Decoupled Weight Decay Regularization, 2019; Smith and Topin, Super-Convergence, 2018.
    """

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        learning_rate: float,
        weight_decay: float,
        total_steps: int,
        warm_up_fraction: float,
    ):
        """Prepare the first step.

        Args:
            parameters: the tensors to optimize; each must have a gradient at every step.
            learning_rate: the maximum of the cycle.
            weight_decay: factor of the weight decay; each step multiplies it by the learning rate.
            total_steps: number of steps of the cycle.
            warm_up_fraction: part of the steps in which the learning rate rises.
        """
        self._parameters = list(parameters)
        self._learning_rate, self._weight_decay = learning_rate, weight_decay
        self._total_steps, self._warm_up_fraction = total_steps, warm_up_fraction
        self._means, self._mean_squares = ([torch.zeros_like(p) for p in self._parameters] for _ in range(2))
        self._step_counts = [torch.zeros((), device=parameter.device) for parameter in self._parameters]
        self._step = 0

    def zero_grad(self) -> None:
        """Set all gradients to None."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Update the parameters with their gradients."""
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
        """Return the learning rate and beta 1 of a step; step 0 is the first."""
        peak_step, last_step = self._warm_up_fraction * self._total_steps - 1, self._total_steps - 1
        rates = (self._learning_rate / INITIAL_RATE_DIVISOR, self._learning_rate)
        betas = (MAX_BETA_1, MIN_BETA_1)
        fraction = step / peak_step if peak_step else 1.0
        if step > peak_step:
            rates, betas = (self._learning_rate, self._learning_rate / FINAL_RATE_DIVISOR), betas[::-1]
            fraction = (step - peak_step) / (last_step - peak_step)
        return _interpolate_cosine(*rates, fraction), _interpolate_cosine(*betas, fraction)


def _interpolate_cosine(start: float, end: float, fraction: float) -> float:
    """Interpolate along half a period of a cosine; `fraction` 0 gives `start`, 1 gives `end`."""
    return end + (start - end) / 2.0 * (1 + math.cos(math.pi * fraction))
