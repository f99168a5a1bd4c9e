# SPDX-License-Identifier: GPL-3.0-or-later
"""The optimizer against PyTorch's own."""

import subprocess
import sys

import pytest
import torch

from trainer.optimizer import OneCycleAdamW


@pytest.mark.parametrize("total_steps", [1, 2, 7, 60])
def test_the_numbers_are_those_of_torch(total_steps):
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(shape, generator=generator) for shape in ((4, 3, 5), (4, 1, 5))]
    ours, theirs = ([torch.nn.Parameter(values.clone()) for values in start] for _ in range(2))
    optimizer = OneCycleAdamW(ours, 0.01, 0.02, total_steps, 0.15)
    reference = torch.optim.AdamW(theirs, lr=0.01, weight_decay=0.02, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(reference, 0.01, total_steps=total_steps, pct_start=0.15)
    for _ in range(total_steps):
        gradients = [torch.randn(values.shape, generator=generator) for values in start]
        for parameters in (ours, theirs):
            for parameter, gradient in zip(parameters, gradients, strict=True):
                parameter.grad = gradient.clone()
        optimizer.step()
        reference.step()
        schedule.step()
        assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_a_training_imports_no_compiler(recording, tmp_path):
    """It takes longer to import than the rest of PyTorch."""
    code = "import sys; from trainer.__main__ import main; print(main(sys.argv[1:]), 'torch._dynamo' in sys.modules)"
    arguments = [recording, tmp_path / "model.onnx", "--epochs", "1", "--hidden", "8"]
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "0 False"
