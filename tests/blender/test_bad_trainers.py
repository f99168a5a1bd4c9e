# SPDX-License-Identifier: GPL-3.0-or-later
"""A trainer that is not there, lacks torch, or dies: `train` says so and leaves no model."""

import os
import re
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from fdda_addon.core.errors import TRY_AGAIN
from fdda_addon.core.messages import Message, MessageType
from fdda_addon.training.environment.choice import PYTHON_VARIABLE

from .conftest import run
from .refusals import Refusal


@pytest.fixture
def refusal(tmp_path, capfd) -> Refusal:
    return Refusal(tmp_path, capfd)


@pytest.fixture
def train(refusal, elbow, tmp_path):
    """Run `train` on the elbow's recording and return the sentence."""

    def run_train(*options: object, status: int = 1) -> str:
        return refusal("train", elbow.recording, tmp_path / "m.onnx", *options, status=status)

    return run_train


def stand_in(folder: Path, monkeypatch: pytest.MonkeyPatch, *lines: str) -> Path:
    """A script that is started in place of the trainer's Python."""
    path = folder / "python"
    path.write_text("\n".join(["#!/bin/sh", *lines, ""]))
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv(PYTHON_VARIABLE, str(path))
    return path


def say(kind: MessageType, **values) -> str:
    return f"echo '{Message(kind, values).encode()}'"


STARTED = say(MessageType.STARTED, partitions=1, poses=1, vertices=1, device="cpu")
PROGRESS = say(MessageType.PROGRESS, epoch=1, epochs=2, validation_mm=0.5)


def test_a_python_without_torch(train, tmp_path, monkeypatch):
    packages = tmp_path / "packages"
    packages.mkdir()
    (packages / "sitecustomize.py").write_text("import sys\nsys.modules['torch'] = None\n")
    monkeypatch.setenv("PYTHONPATH", str(packages))
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    text = train()
    python = os.environ.get(PYTHON_VARIABLE) or sys.executable
    assert text.startswith(f"Training needs the Python package 'torch', which {python} does not have; install torch")
    assert PYTHON_VARIABLE in text


def test_a_python_that_finds_no_trainer(train, tmp_path, monkeypatch):
    stand_in(tmp_path, monkeypatch, f'exec "{sys.executable}" -I -S "$@"')
    assert re.match(
        r"The trainer ended with status 1 before it was done \(.*trainer.*\); no model was written", train()
    )


def test_a_python_that_is_not_there(train, monkeypatch):
    monkeypatch.setenv(PYTHON_VARIABLE, "/none/python")
    assert train() == (
        "The trainer's Python '/none/python' cannot be started (No such file or directory); set FDDA_TRAINER_PYTHON to "
        "a Python that has torch."
    )


def test_a_python_that_is_no_program(train, tmp_path, monkeypatch):
    path = tmp_path / "python"
    path.write_text("")
    monkeypatch.setenv(PYTHON_VARIABLE, str(path))
    assert "cannot be started (Permission denied)" in train()


def test_a_trainer_that_ends_without_a_word(train, tmp_path, monkeypatch):
    stand_in(tmp_path, monkeypatch, "exit 3")
    assert train() == "The trainer ended with status 3 before it was done; no model was written, train again."


def test_a_trainer_that_ends_well_without_a_word(train, tmp_path, monkeypatch):
    stand_in(tmp_path, monkeypatch, STARTED, "exit 0")
    assert "The trainer ended with status 0 before it was done;" in train()


def test_a_trainer_that_complains_and_ends(train, tmp_path, monkeypatch):
    stand_in(tmp_path, monkeypatch, "echo first >&2; echo 'ImportError: libtorch.so' >&2; exit 1")
    assert train() == (
        "The trainer ended with status 1 before it was done (ImportError: libtorch.so); no model was written, "
        "train again."
    )


@pytest.mark.parametrize("verb", ["train", "record"])
def test_no_temporary_folder_takes_a_file(refusal, elbow, tmp_path, monkeypatch, verb):
    arguments = {
        "train": ["train", elbow.recording, tmp_path / "m.onnx"],
        "record": ["record", elbow.rig, tmp_path / "r", "--poses", 20, "--fit-linear", "hard"],
    }[verb]
    with monkeypatch.context() as patch:
        patch.setattr(tempfile, "tempdir", None)
        patch.setattr(tempfile, "_candidate_tempdir_list", lambda: [str(tmp_path / "none")])
        text = refusal(*arguments, status=TRY_AGAIN)
    assert text.startswith("No temporary file can be written (No usable temporary directory found in [")
    assert text.endswith("); make room there, or name another folder in TMPDIR.")


def test_a_trainer_that_is_killed(train, tmp_path, monkeypatch):
    stand_in(tmp_path, monkeypatch, STARTED, PROGRESS, "kill -9 $$")
    sentence = "The trainer was ended by signal 9 before it was done; no model was written, train again."
    assert train(status=TRY_AGAIN) == sentence


def test_a_trainer_that_fails_in_a_sentence(train, tmp_path, monkeypatch):
    stand_in(tmp_path, monkeypatch, STARTED, say(MessageType.FAILED, text="The sky fell; wait."), "exit 1")
    assert train() == "The sky fell; wait."


def test_lines_that_are_no_messages_are_passed_over(train, tmp_path, monkeypatch):
    stand_in(
        tmp_path, monkeypatch, "echo a warning", "echo {}", STARTED, "echo", say(MessageType.FAILED, text="Enough.")
    )
    assert train() == "Enough."


def test_a_trainer_that_is_cancelled_by_someone_else(elbow, tmp_path, monkeypatch, capsys):
    stand_in(tmp_path, monkeypatch, STARTED, say(MessageType.CANCELLED), "exit 130")
    assert run("train", elbow.recording, tmp_path / "m.onnx") == 130
    assert not (tmp_path / "m.onnx").exists()


def test_a_trainer_that_does_not_stop_is_stopped(elbow, tmp_path, monkeypatch):
    """Leaving the block ends the process, also one that would go on for an hour."""
    from fdda_addon.training.process import Training

    stand_in(tmp_path, monkeypatch, f"echo $$ > '{tmp_path}/pid'", STARTED, "exec sleep 3600")
    with Training([]) as training:
        assert next(training.messages()).type is MessageType.STARTED
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_nobody_waits_for_a_trainer_that_is_silent(tmp_path, monkeypatch):
    """As a window has it: a poll is answered at once, and a cancelled trainer ends without an error."""
    from fdda_addon.training.process import Training

    stand_in(tmp_path, monkeypatch, STARTED, "exec sleep 3600")
    with Training([]) as training:
        messages = training.messages(wait=False)
        seen = first_of(messages)
        assert seen.type is MessageType.STARTED
        start = time.monotonic()
        assert [next(messages) for _ in range(100)] == [None] * 100
        assert time.monotonic() - start < 0.05
        training.cancel()
        assert first_of(messages) is None


def first_of(messages: Iterator[Message | None], seconds: float = 20) -> Message | None:
    """The next message of a training that is polled; None when it has ended."""
    until = time.monotonic() + seconds
    for message in messages:
        if message is not None:
            return message
        assert time.monotonic() < until, "neither a message nor an end"
        time.sleep(0.01)
    return None
