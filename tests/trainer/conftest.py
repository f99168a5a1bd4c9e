# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures that the tests share: a recording of the chain, and a training on this recording."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from trainer.__main__ import main  # Imported first, because torch reads the variables that it sets.

from .chain import write_chain

REPOSITORY = Path(__file__).resolve().parents[2]
QUICK_OPTIONS = ("--passes", "40", "--hidden", "24", "24", "--batch-size", "16")


def start_trainer(*arguments: str | Path, **options) -> subprocess.Popen:
    """Start `python -m trainer` with pipes for stdout and stderr."""
    return subprocess.Popen(
        [sys.executable, "-m", "trainer", *map(str, arguments)],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        **options,
    )


@pytest.fixture(scope="session")
def recording(tmp_path_factory) -> Path:
    """Folder of a recording of the chain; read only."""
    path = tmp_path_factory.mktemp("recordings") / "chain"
    write_chain(path)
    return path


@pytest.fixture(scope="session")
def trained(recording, tmp_path_factory) -> Path:
    """Folder of a finished training of the chain: model.onnx, report.json, report.html; read only."""
    folder = tmp_path_factory.mktemp("trained")
    assert main([str(recording), str(folder / "model.onnx"), *QUICK_OPTIONS]) == 0
    return folder


@pytest.fixture(scope="session")
def report(trained) -> dict:
    return json.loads((trained / "report.json").read_text(encoding="utf-8"))
