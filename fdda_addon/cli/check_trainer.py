# SPDX-License-Identifier: GPL-3.0-or-later
"""`check-trainer`: checks the Python that trains, as the preferences do."""

import argparse

from ..core.errors import TrainerEnvironmentError
from ..training.environment.choice import check_trainer_python


def add_options(_parser: argparse.ArgumentParser) -> None:
    """Declare no options."""


def run(_options: argparse.Namespace) -> None:
    """Print the result of the check.

    Raises:
        TrainerEnvironmentError: it cannot train.
    """
    answer = check_trainer_python()
    for line in answer.details:
        print(line)
    if answer.level == "ERROR":
        raise TrainerEnvironmentError(answer.message)
    print(answer.message)
