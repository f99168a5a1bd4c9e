# SPDX-License-Identifier: GPL-3.0-or-later
"""The optimizer computes the same parameters as PyTorch's optimizer."""

import subprocess
import sys

import torch

from trainer.networks.loop import MIN_BETA_1, OneCycleAdamW

from .conftest import REPOSITORY


def test_parameters_equal_those_of_torch():
    command = [sys.executable, "-m", "tests.trainer.optimizer_comparison"]
    assert subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout == "equal\n"


def test_a_warm_up_of_one_step_starts_at_the_maximum():
    optimizer = OneCycleAdamW([torch.nn.Parameter(torch.zeros(1))], 0.01, 0.0, total_steps=4, warm_up_fraction=0.25)
    assert optimizer.schedule(0) == (0.01, MIN_BETA_1)
    assert optimizer.schedule(1)[0] < 0.01
