# SPDX-License-Identifier: GPL-3.0-or-later
"""`pytest` alone runs every tier that this Python can run; of each other one it prints a line with what to type."""

import os
import signal
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

# Blender sets it when it is imported, and names its value in its output where it was set before: in the processes of
# pytest-xdist, whose first process imports Blender.
os.environ.pop("OCIO", None)

TESTS = Path(__file__).resolve().parent
TRAINER_PYTHON = "FDDA_TRAINER_PYTHON"
NEEDS = {
    "core": ("numpy", "onnx"),
    "contract": ("numpy",),
    "trainer": ("torch", "onnx", "onnxruntime", "matplotlib", "scipy"),
    "blender": ("bpy", "onnxruntime", "onnx"),
    "farm": ("distributed", "openjd", "bpy", "torch", "onnxruntime"),
    "examples": ("bpy", "torch", "onnx", "onnxruntime"),
}
"""Packages, by the folder of a tier."""


def why_not(tier: str) -> str | None:
    """Why this Python cannot run a tier, and what to type; None where it can."""
    target = "test-core" if tier == "contract" else f"test-{tier}"
    if lacking := [package for package in NEEDS[tier] if find_spec(package) is None]:
        return f"tests/{tier} needs {' and '.join(lacking)}, which {sys.executable} lacks: make {target}"
    if tier == "blender" and TRAINER_PYTHON not in os.environ:
        return f"tests/{tier} trains models; set {TRAINER_PYTHON} to a Python that has torch, or: make {target}"
    return None


class SkippedTier(pytest.Collector):
    """Stands for a tier that this Python cannot run."""

    def collect(self) -> Iterator[pytest.Item]:
        pytest.skip(why_not(self.name), allow_module_level=True)


def heed_stop_signals() -> None:
    """Let children be stopped by signals that this process ignores, as below nohup: they inherit no handler."""
    for name in ("SIGINT", "SIGHUP"):
        number = getattr(signal, name, None)
        if number and signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, lambda *_: None)


def pytest_configure() -> None:
    """Name the Python that trains for the Blender tier, as make does."""
    heed_stop_signals()
    of_the_checkout = TESTS.parent / ".venv/bin/python"
    if find_spec("torch"):
        os.environ.setdefault(TRAINER_PYTHON, sys.executable)
    elif of_the_checkout.is_file():
        os.environ.setdefault(TRAINER_PYTHON, str(of_the_checkout))


def pytest_collect_directory(path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    if path.parent == TESTS and path.name in NEEDS and why_not(path.name):
        return SkippedTier.from_parent(parent, name=path.name)
    return None
