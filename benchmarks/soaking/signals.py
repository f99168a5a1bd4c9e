# SPDX-License-Identifier: GPL-3.0-or-later
"""Soak test of stopped trainings: they end soon without being killed, and leave a complete model or none."""

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

from .cases import CaseFailedError, print_case, run_case

ROOT = Path(__file__).resolve().parents[2]
TRAINING_OPTIONS = ("--epochs", "10", "--hidden", "4", "4")
MAX_STOP_SECONDS = 20
"""Time limit for a training to end after its verb was stopped."""
OUTPUT_FILE_COUNT = 4
"""Files of a finished training: model, two reports, checkpoint."""
STOP_KINDS = ("canceled", "attached", "interrupted", "killed")


def run(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Stop trainings in four ways: from the sidebar, from another Blender, by a signal to the verb, by killing it."""
    detached_process.user_folder = lambda: folder / "user"
    stop_functions = {"canceled": _cancel, "attached": _cancel_attached, "interrupted": _interrupt, "killed": _kill}
    for case_index in range(first_case, end_case):
        random, kind = np.random.default_rng((seed, case_index)), STOP_KINDS[case_index % len(STOP_KINDS)]
        name, stop = f"signal {seed}/{case_index} ({kind})", stop_functions[kind]
        print_case(run_case("signals", name, lambda s=stop, r=random: _check_stop(folder, s, r)))


def _check_stop(folder: Path, stop, random: np.random.Generator) -> None:
    output = folder / "stopped training"
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir()
    model = output / "m.onnx"
    has_old_model = bool(random.integers(2))
    if has_old_model:
        shutil.copy(folder / "elbow.onnx", model)
    old_data = model.read_bytes() if has_old_model else b""
    status = stop([str(folder / "short recording"), str(model), *TRAINING_OPTIONS], model, random)
    if status not in (INTERRUPTED, 0):
        raise CaseFailedError(f"exit status {status}")
    files = sorted(path.name for path in output.iterdir())
    is_unchanged = files == ["m.onnx"] * has_old_model and (not has_old_model or model.read_bytes() == old_data)
    if status == INTERRUPTED and not is_unchanged:
        raise CaseFailedError(f"the training was stopped, but changed its output: {files}")
    if status == 0 and len(files) != OUTPUT_FILE_COUNT:
        raise CaseFailedError(f"the training finished, but its output is {files}")
    if model.exists():
        read_model(model)
    for path in (folder / "user").rglob("*"):
        if path.is_file():
            raise CaseFailedError(f"'{path}' was not removed")


def _cancel(arguments: list[str], _model: Path, random: np.random.Generator) -> int:
    with process.Training(arguments) as training:
        _wait_for_random_moment(training, random)
        return _cancel_and_wait(training)


def _cancel_attached(arguments: list[str], model: Path, random: np.random.Generator) -> int:
    with detached_process.DetachedTraining(arguments, model) as training:
        training.detach()
    popen = detached_process._child_processes.pop(training._process.pid)
    with detached_process.AttachedTraining(model) as attached:
        _wait_for_random_moment(attached, random)
        _cancel_and_wait(attached)
    return popen.wait()


def _wait_for_random_moment(training: process.Training, random: np.random.Generator) -> None:
    """Wait for a random time after the start of a training or after its first message."""
    if random.integers(2):
        time.sleep(float(random.uniform(0, 4)))
    else:
        next(training.messages())
        time.sleep(float(random.exponential(0.5)))


def _cancel_and_wait(training: process.Training) -> int | None:
    training.cancel()
    started = time.monotonic()
    for _ in training.messages():
        pass
    if (seconds := time.monotonic() - started) > process.KILL_AFTER_SECONDS:
        raise CaseFailedError(f"the training did not end and was killed after {seconds:.0f} s")
    return training._process.wait()


def _interrupt(arguments: list[str], model: Path, random: np.random.Generator) -> int:
    signal_names = ("CTRL_BREAK_EVENT",) if os.name == "nt" else ("SIGINT", "SIGTERM", "SIGHUP")
    verb = _start_verb(arguments)
    time.sleep(float(random.uniform(0, 6)))
    verb.send_signal(getattr(signal, str(random.choice(signal_names))))
    _, errors = verb.communicate()
    if b"Traceback" in errors:
        raise CaseFailedError(f"a traceback: {errors.decode(errors='replace')[-300:]}")
    _wait_for_trainer_end(model)
    return verb.returncode


def _kill(arguments: list[str], model: Path, random: np.random.Generator) -> int:
    verb = _start_verb(arguments)
    time.sleep(float(random.uniform(0, 6)))
    verb.kill()
    verb.communicate()
    _wait_for_trainer_end(model)
    return 0 if len(list(model.parent.iterdir())) == OUTPUT_FILE_COUNT else INTERRUPTED


def _start_verb(arguments: list[str]) -> subprocess.Popen:
    options = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP} if os.name == "nt" else {}
    command = [sys.executable, "-m", "fdda_addon", "train", *arguments]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)


def _wait_for_trainer_end(model: Path) -> None:
    """Wait until the trainer of a model has ended; without /proc, do not wait."""
    deadline = time.monotonic() + MAX_STOP_SECONDS
    while any(str(model).encode() in line for line in map(_read_command_line, Path("/proc").glob("[0-9]*/cmdline"))):
        if time.monotonic() > deadline:
            raise CaseFailedError(f"the trainer still runs {MAX_STOP_SECONDS} s after its verb")
        time.sleep(0.1)


def _read_command_line(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""
