# SPDX-License-Identifier: GPL-3.0-or-later
"""Cancels and kills trainings at random moments: they end by themselves, soon, and leave a whole model or none."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from fdda_addon.core.model import read_model
from fdda_addon.core.stop_signals import INTERRUPTED
from fdda_addon.training import detached_process, process

from .cases import ShortfallError, attempt, say

ROOT = Path(__file__).resolve().parents[2]
TRAINING = ("--epochs", "10", "--hidden", "4", "4")
SECONDS = 20
"""A training that is asked to stop at a random moment has ended after so long."""
KINDS = ("cancelled", "followed", "interrupted", "killed")


def run(folder: Path, seed: int, first: int, end: int) -> None:
    """Stop trainings in four ways: by the sidebar, by another Blender, by a signal to the verb, by its death."""
    detached_process.user_folder = lambda: folder / "user"
    for number in range(first, end):
        random, kind = np.random.default_rng((seed, number)), KINDS[number % len(KINDS)]
        action = {"cancelled": _cancel, "followed": _follow, "interrupted": _interrupt, "killed": _kill}[kind]
        say(attempt("signals", f"signal {seed}/{number} ({kind})", lambda a=action, r=random: _stop(folder, a, r)))


def _stop(folder: Path, action, random: np.random.Generator) -> None:
    place = folder / "stopped training"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    model = place / "m.onnx"
    had = bool(random.integers(2))
    if had:
        shutil.copy(folder / "elbow.onnx", model)
    before = model.read_bytes() if had else b""
    status = action([str(folder / "short recording"), str(model), *TRAINING], model, random)
    if status not in (INTERRUPTED, 0):
        raise ShortfallError(f"exit status {status}")
    left = sorted(path.name for path in place.iterdir())
    if status == INTERRUPTED and (left != ["m.onnx"] * had or (had and model.read_bytes() != before)):
        raise ShortfallError(f"it was stopped and left {left}")
    if status == 0 and len(left) != 4:
        raise ShortfallError(f"it was done and left {left}")
    if model.exists():
        read_model(model)
    for path in (folder / "user").rglob("*"):
        if path.is_file():
            raise ShortfallError(f"'{path}' is left")


def _cancel(arguments: list[str], _model: Path, random: np.random.Generator) -> int:
    with process.Training(arguments) as training:
        _wait(training, random)
        return _cancelled(training)


def _follow(arguments: list[str], model: Path, random: np.random.Generator) -> int:
    with detached_process.DetachedTraining(arguments, model) as training:
        training.detach()
    popen = detached_process._child_processes.pop(training._process.pid)
    with detached_process.AttachedTraining(model) as followed:
        _wait(followed, random)
        _cancelled(followed)
    return popen.wait()


def _wait(training: process.Training, random: np.random.Generator) -> None:
    """Until a moment of its start, or a moment after its first message."""
    if random.integers(2):
        time.sleep(float(random.uniform(0, 4)))
    else:
        next(training.messages())
        time.sleep(float(random.exponential(0.5)))


def _cancelled(training: process.Training) -> int | None:
    training.cancel()
    began = time.monotonic()
    for _ in training.messages():
        pass
    if (seconds := time.monotonic() - began) > process.KILL_AFTER_SECONDS:
        raise ShortfallError(f"it was killed after {seconds:.0f} s")
    return training._process.wait()


def _interrupt(arguments: list[str], model: Path, random: np.random.Generator) -> int:
    requests = ("CTRL_BREAK_EVENT",) if os.name == "nt" else ("SIGINT", "SIGTERM", "SIGHUP")
    verb = _verb(arguments)
    time.sleep(float(random.uniform(0, 6)))
    verb.send_signal(getattr(signal, str(random.choice(requests))))
    _, errors = verb.communicate()
    if b"Traceback" in errors:
        raise ShortfallError(f"a traceback: {errors.decode(errors='replace')[-300:]}")
    _gone(model)
    return verb.returncode


def _kill(arguments: list[str], model: Path, random: np.random.Generator) -> int:
    verb = _verb(arguments)
    time.sleep(float(random.uniform(0, 6)))
    verb.kill()
    verb.communicate()
    _gone(model)
    return 0 if len(list(model.parent.iterdir())) == 4 else INTERRUPTED


def _verb(arguments: list[str]) -> subprocess.Popen:
    own = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP} if os.name == "nt" else {}
    command = [sys.executable, "-m", "fdda_addon", "train", *arguments]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **own)


def _gone(model: Path) -> None:
    """Wait for the trainer of a model, whose verb is gone; where the system lists processes as Linux does."""
    end = time.monotonic() + SECONDS
    while any(str(model).encode() in line for line in map(_command, Path("/proc").glob("[0-9]*/cmdline"))):
        if time.monotonic() > end:
            raise ShortfallError(f"the trainer goes on {SECONDS} s after its verb")
        time.sleep(0.1)


def _command(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""
