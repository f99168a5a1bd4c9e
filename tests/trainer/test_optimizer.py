# SPDX-License-Identifier: GPL-3.0-or-later
"""The optimizer computes the same parameters as PyTorch's optimizer."""

import subprocess
import sys

import torch

from trainer.networks.optimizer import MIN_BETA_1, OneCycleAdamW

from .conftest import REPOSITORY


def output_of(*arguments: object) -> list[str]:
    """Run a separate Python process and return the lines that it prints."""
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout.splitlines()


def test_parameters_equal_those_of_torch():
    assert output_of("-m", "tests.trainer.optimizer_comparison") == ["equal"]


def test_a_warm_up_of_one_step_starts_at_the_maximum():
    optimizer = OneCycleAdamW([torch.nn.Parameter(torch.zeros(1))], 0.01, 0.0, total_steps=4, warm_up_fraction=0.25)
    assert optimizer.schedule(0) == (0.01, MIN_BETA_1)
    assert optimizer.schedule(1)[0] < 0.01


def test_a_training_imports_no_compiler(recording, tmp_path):
    """PyTorch's compiler takes long to import, and a training does not need it."""
    code = "import sys; from trainer.__main__ import main; print(main(sys.argv[1:]), 'torch._dynamo' in sys.modules)"
    arguments = [recording, tmp_path / "model.onnx", "--passes", "1", "--hidden", "8"]
    assert output_of("-c", code, *arguments)[-1] == "0 False"
