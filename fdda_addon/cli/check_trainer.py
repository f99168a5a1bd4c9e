# SPDX-License-Identifier: GPL-3.0-or-later
"""`check-trainer`: whether the Python that trains can, as the preferences show it."""

import argparse

from ..core.errors import TrainerEnvironmentError
from ..training.environment.choice import check_trainer_python


def add_options(_parser: argparse.ArgumentParser) -> None:
    """It has none."""


def run(_options: argparse.Namespace) -> None:
    """Print what the Python says of itself.

    Raises:
        TrainerEnvironmentError: it cannot train.
    """
    answer = check_trainer_python()
    for line in answer.details:
        print(line)
    if answer.level == "ERROR":
        raise TrainerEnvironmentError(answer.message)
    print(answer.message)
