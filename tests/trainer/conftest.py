# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures that the tests share: a recording of the chain, and a training on this recording."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from trainer.__main__ import main  # Imported first, because torch reads the variables that it sets.

import trainer.train  # isort: skip
from trainer.model import TrainedModel  # isort: skip

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


def train_model(recording: Path, model: Path) -> TrainedModel:
    """Train a model with the verb, and return what was exported."""
    trained_models, make_trained_model = [], trainer.train.make_trained_model
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(
            trainer.train,
            "make_trained_model",
            lambda *args: trained_models.append(make_trained_model(*args)) or trained_models[-1],
        )
        assert main([str(recording), str(model), *QUICK_OPTIONS]) == 0
    return trained_models[0]


@pytest.fixture(scope="session")
def training(recording, tmp_path_factory) -> tuple[Path, TrainedModel]:
    folder = tmp_path_factory.mktemp("trained")
    return folder, train_model(recording, folder / "model.onnx")


@pytest.fixture(scope="session")
def trained(training) -> Path:
    """Folder of a finished training of the chain: model.onnx, report.json, report.html; read only."""
    return training[0]


@pytest.fixture(scope="session")
def trained_model(training) -> TrainedModel:
    return training[1]


@pytest.fixture(scope="session")
def report(trained) -> dict:
    return json.loads((trained / "report.json").read_text(encoding="utf-8"))
