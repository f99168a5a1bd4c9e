# SPDX-License-Identifier: GPL-3.0-or-later
"""Which Python trains, and who chose it."""

import enum
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from .check_result import CheckResult
from .folder import environment_python, interpreter_path

PYTHON_VARIABLE = "FDDA_TRAINER_PYTHON"
"""Environment variable: the Python that has torch, when the preferences name none."""

preferred_python: Callable[[], str] | None = None
"""What the preferences name, an interpreter or the folder of a virtual environment; `preferences` puts it here."""


class Origin(enum.Enum):
    """Who chose the trainer's Python; the value says what to do when it is the wrong one."""

    PREFERENCES = "choose another Python in the add-on's preferences, or leave that field empty"
    VARIABLE = f"set {PYTHON_VARIABLE} to a Python that has torch"
    OWN = "reinstall the training environment in the add-on's preferences"
    THIS = (
        f"install the training environment in the add-on's preferences, or set {PYTHON_VARIABLE} to a Python with torch"
    )


class TrainerPython(NamedTuple):
    """The interpreter that runs the trainer, and who chose it."""

    path: str
    origin: Origin


def select_python() -> TrainerPython:
    """The Python that runs the trainer.

    The first of: what the preferences name, the environment variable, the add-on's own environment, and the Python
    that runs this. Blender says where the own environment lies: where bpy cannot be imported, nobody made one.
    """
    if preferred_python is not None and (preferred := preferred_python()):
        folder = Path(preferred)
        return TrainerPython(str(interpreter_path(folder)) if folder.is_dir() else preferred, Origin.PREFERENCES)
    if named := os.environ.get(PYTHON_VARIABLE):
        return TrainerPython(named, Origin.VARIABLE)
    with suppress(ImportError):
        if own := environment_python():
            return TrainerPython(own, Origin.OWN)
    return TrainerPython(sys.executable, Origin.THIS)


def check_trainer_python(python: TrainerPython | None = None) -> CheckResult:
    """Ask the Python that runs the trainer whether it can train. Takes seconds: never while drawing."""
    from .check import check

    python = python or select_python()
    return check(python.path, python.origin.value)
