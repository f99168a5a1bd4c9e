# SPDX-License-Identifier: GPL-3.0-or-later
"""`pytest` without arguments runs every tier that this Python supports; for other tiers it prints what to run."""

import os
import signal
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

# Importing Blender sets this variable, and processes of pytest-xdist inherit it. If it is already set, Blender prints a
# line about it.
os.environ.pop("OCIO", None)

TESTS = Path(__file__).resolve().parent
TRAINER_PYTHON_VARIABLE = "FDDA_TRAINER_PYTHON"
PACKAGES_OF_TIERS = {
    "core": ("numpy", "onnx"),
    "contract": ("numpy",),
    "trainer": ("torch", "onnx", "onnxruntime", "scipy"),
    "blender": ("bpy", "onnxruntime", "onnx"),
    "farm": ("snakemake", "openjd"),
    "examples": ("bpy", "torch", "onnx", "onnxruntime", "matplotlib"),
}
"""Packages that the tests of a tier import, by the name of its folder."""


def reason_to_skip(tier: str) -> str | None:
    """Return why this Python cannot run a tier and which command can; None if it can."""
    make_target = "test-core" if tier == "contract" else f"test-{tier}"
    if missing_packages := [package for package in PACKAGES_OF_TIERS[tier] if find_spec(package) is None]:
        return f"tests/{tier} needs {' and '.join(missing_packages)}, which {sys.executable} lacks: make {make_target}"
    if tier == "blender" and TRAINER_PYTHON_VARIABLE not in os.environ:
        return (
            f"tests/{tier} trains models; set {TRAINER_PYTHON_VARIABLE} to a Python that has torch, "
            f"or: make {make_target}"
        )
    return None


class SkippedTier(pytest.Collector):
    """Skip a tier that this Python cannot run."""

    def collect(self) -> Iterator[pytest.Item]:
        pytest.skip(reason_to_skip(self.name), allow_module_level=True)


def enable_stop_signals() -> None:
    """Handle stop signals that this process ignores, as under nohup; child processes then do not ignore them.

    Child processes inherit ignored signals, but not handlers.
    """
    for signal_name in ("SIGINT", "SIGHUP"):
        signal_number = getattr(signal, signal_name, None)
        if signal_number and signal.getsignal(signal_number) is signal.SIG_IGN:
            signal.signal(signal_number, lambda *_: None)


def pytest_configure() -> None:
    """Set the variable with the trainer's Python for the Blender tier, as make does."""
    enable_stop_signals()
    venv_python = TESTS.parent / ".venv/bin/python"
    if find_spec("torch"):
        os.environ.setdefault(TRAINER_PYTHON_VARIABLE, sys.executable)
    elif venv_python.is_file():
        os.environ.setdefault(TRAINER_PYTHON_VARIABLE, str(venv_python))


def pytest_collect_directory(path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    if path.parent == TESTS and path.name in PACKAGES_OF_TIERS and reason_to_skip(path.name):
        return SkippedTier.from_parent(parent, name=path.name)
    return None
