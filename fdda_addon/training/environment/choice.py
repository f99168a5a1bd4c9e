# SPDX-License-Identifier: GPL-3.0-or-later
"""Selects the Python that trains."""

import enum
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from .check import CheckResult, check
from .folder import environment_python, interpreter_path

PYTHON_VARIABLE = "FDDA_TRAINER_PYTHON"
"""Environment variable with the path of a Python that has torch, used if the preferences name none."""

preferred_python: Callable[[], str] | None = None
"""Function that returns the interpreter or virtual environment in the preferences. `preferences` sets it."""


class Origin(enum.Enum):
    """Where the path of the trainer's Python comes from. The value is the advice if that Python cannot train."""

    PREFERENCES = "choose another Python in the add-on's preferences, or leave that field empty"
    VARIABLE = f"set {PYTHON_VARIABLE} to a Python that has torch"
    OWN = "reinstall the training environment in the add-on's preferences"
    THIS = (
        f"install the training environment in the add-on's preferences, or set {PYTHON_VARIABLE} to a Python with torch"
    )


class TrainerPython(NamedTuple):
    """Path of the interpreter that runs the trainer, and where the path comes from."""

    path: str
    origin: Origin


def select_python() -> TrainerPython:
    """Select the Python that runs the trainer.

    The first of these that exists is used: the path in the preferences, the path in the environment variable, the
    add-on's environment, this Python. The add-on's environment is found only if bpy can be imported.
    """
    if preferred_python is not None and (preferred := preferred_python()):
        folder = Path(preferred)
        return TrainerPython(str(interpreter_path(folder)) if folder.is_dir() else preferred, Origin.PREFERENCES)
    if variable_path := os.environ.get(PYTHON_VARIABLE):
        return TrainerPython(variable_path, Origin.VARIABLE)
    with suppress(ImportError):
        if environment_path := environment_python():
            return TrainerPython(environment_path, Origin.OWN)
    return TrainerPython(sys.executable, Origin.THIS)


def check_trainer_python(python: TrainerPython | None = None) -> CheckResult:
    """Check the Python that runs the trainer. Takes seconds, so never call it while drawing."""
    python = python or select_python()
    return check(python.path, python.origin.value)
