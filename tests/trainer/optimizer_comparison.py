# SPDX-License-Identifier: GPL-3.0-or-later
"""Compares the optimizer with PyTorch's. It runs in a separate process, because PyTorch's compiler crashes Blender."""

import itertools

import torch

from trainer.networks.loop import OneCycleAdamW

TOTAL_STEPS = (1, 2, 7, 60)
WARM_UP_FRACTIONS = (0.15, 0.4)


def compare(total_steps: int, warm_up_fraction: float) -> None:
    """Assert that both optimizers compute bit-equal parameters from the same gradients."""
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(shape, generator=generator) for shape in ((4, 3, 5), (4, 1, 5))]
    ours, theirs = ([torch.nn.Parameter(values.clone()) for values in start] for _ in range(2))
    optimizer = OneCycleAdamW(ours, 0.01, 0.02, total_steps, warm_up_fraction)
    reference = torch.optim.AdamW(theirs, lr=0.01, weight_decay=0.02, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(reference, 0.01, total_steps=total_steps, pct_start=warm_up_fraction)
    for _ in range(total_steps):
        gradients = [torch.randn(values.shape, generator=generator) for values in start]
        for parameters in (ours, theirs):
            for parameter, gradient in zip(parameters, gradients, strict=True):
                parameter.grad = gradient.clone()
        optimizer.step()
        reference.step()
        schedule.step()
        assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True)), total_steps


if __name__ == "__main__":
    for total_steps, warm_up_fraction in itertools.product(TOTAL_STEPS, WARM_UP_FRACTIONS):
        compare(total_steps, warm_up_fraction)
    print("equal")
