# SPDX-License-Identifier: GPL-3.0-or-later
"""`check-trainer`: checks the Python that trains, as Check Setup in the preferences does."""

import argparse

from ..core.errors import TrainerEnvironmentError
from ..training.environment.choice import check_trainer_python


def add_options(_parser: argparse.ArgumentParser) -> None:
    """Add no options: the verb has none."""


def run(_options: argparse.Namespace) -> None:
    """Print the result of the check.

    Raises:
        TrainerEnvironmentError: the Python cannot train.
    """
    result = check_trainer_python()
    for line in result.details:
        print(line)
    if result.level == "ERROR":
        raise TrainerEnvironmentError(result.message)
    print(result.message)
