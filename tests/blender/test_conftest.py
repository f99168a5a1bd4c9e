# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors of the process that trains all models of the tests."""

import sys
from functools import cache
from pathlib import Path

import pytest

from blend_fixtures.characters import training

from . import conftest

FAKE_TRAINER = """
import sys
for line in sys.stdin:
    if "die" in line:
        sys.exit()
    print("error of", line, file=sys.stderr, flush=True)
    print(int("fail" in line), flush=True)
"""
"""Program that ends if its arguments contain "die", and answers with status 1 if they contain "fail"."""


@pytest.fixture
def _fake_trainer(monkeypatch: pytest.MonkeyPatch):
    command = [sys.executable, "-c", FAKE_TRAINER]
    monkeypatch.setattr(training, "trainer_command", lambda _arguments, module: (command, None))
    trainings = cache(training.Trainings)
    monkeypatch.setattr(conftest, "_shared_trainings", trainings)
    yield
    trainings().close()


@pytest.mark.parametrize("option", ["--fail", "--die"])
def test_training_works_after_a_failed_training(_fake_trainer, option):
    files = (Path("recording"), Path("m.onnx"))
    conftest.train(*files)
    with pytest.raises(RuntimeError, match=option):
        conftest.train(*files, option)
    conftest.train(*files)


def test_an_error_message_leaves_out_earlier_trainings(_fake_trainer):
    conftest.train(Path("earlier"), Path("m.onnx"))
    with pytest.raises(RuntimeError, match=r"error of .*later") as error:
        conftest.train(Path("later"), Path("m.onnx"), "--fail")
    assert "earlier" not in str(error.value)
