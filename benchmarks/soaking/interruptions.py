# SPDX-License-Identifier: GPL-3.0-or-later
"""Soak test of killed verbs and full disks.

Complete poses and existing files must survive, and a resumed recording must be bit-identical to an uninterrupted one.
"""

import ctypes
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from fdda_addon.core.formats.model import read_model
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import read_recording

from .cases import CaseFailedError, is_sentence, print_case, run_case

ROOT = Path(__file__).resolve().parents[2]
POSES = 40
TRAINING_OPTIONS = ("--passes", "3", "--hidden", "4", "4")
KILLED_PROCESSES = ("record", "train", "write")
DISK_VERBS = ("record", "train", "bind", "evaluate")
DISK_FULL_STATUS = 75
WRITER_SCRIPT = """
import sys
from pathlib import Path
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter
source, path = map(Path, sys.argv[1:])
recording = read_recording(source)
print("ready", flush=True)
with RecordingWriter(path, recording.rig, recording.info, resume=path.exists()) as writer:
    while writer.complete < len(recording.pose_matrices):
        poses = slice(writer.complete, writer.complete + 1)
        writer.append(recording.pose_matrices[poses], recording.positions[poses])
"""


def run_kills(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Kill verbs and a recording writer at random moments, and resume them."""
    for case_index in range(first_case, end_case):
        random = np.random.default_rng((seed, case_index))
        kind = KILLED_PROCESSES[case_index % len(KILLED_PROCESSES)]
        action = {"record": _kill_record, "train": _kill_train, "write": _kill_writer}[kind]
        print_case(run_case("kills", f"kill {seed}/{case_index} ({kind})", lambda a=action, r=random: a(folder, r)))


def run_full_disks(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Run verbs on disks of random sizes."""
    for case_index in range(first_case, end_case):
        random, verb = np.random.default_rng((seed, case_index)), DISK_VERBS[case_index % len(DISK_VERBS)]
        name = f"full disk {seed}/{case_index} ({verb})"
        print_case(run_case("full disks", name, lambda v=verb, r=random: _run_on_small_disk(folder, v, r)))


def _verb_command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "fdda_addon", *map(str, arguments)]


def _run_and_kill(command: list[str], seconds: float) -> bool:
    """Run a command and kill it after a number of seconds; return whether it was still running."""
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        output, _ = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.communicate()
        return True
    if process.returncode:
        raise CaseFailedError(f"exit status {process.returncode}: {output.decode()[-300:]}")
    return False


def _check_same_arrays(recording: Path, reference: Path) -> None:
    for path in reference.glob("*.npy"):
        if path.read_bytes() != (recording / path.name).read_bytes():
            raise CaseFailedError(f"{path.name} differs from that of an uninterrupted recording")


def _kill_record(folder: Path, random: np.random.Generator) -> None:
    recording = folder / "killed recording"
    shutil.rmtree(recording, ignore_errors=True)
    for _ in range(3):
        if recording.exists() and (recording / "recording.json").exists():
            read_index(recording)
        resume = ("--resume",) if recording.exists() else ()
        command = _verb_command("record", folder / "elbow.blend", recording, "--poses", POSES, *resume)
        if not _run_and_kill(command, float(random.uniform(0.5, 2.5))):
            break
    index = read_index(recording) if (recording / "recording.json").exists() else {"complete": 0, "poses": POSES}
    if index["complete"] < index["poses"]:
        resume = ("--resume",) if recording.exists() else ()
        command = _verb_command("record", folder / "elbow.blend", recording, "--poses", POSES, *resume)
        if _run_and_kill(command, 60):
            raise CaseFailedError("the resumed recording does not end")
    read_recording(recording)
    _check_same_arrays(recording, folder / "short recording")


def _kill_train(folder: Path, random: np.random.Generator) -> None:
    output = folder / "killed training"
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir()
    model = output / "m.onnx"
    has_old_model = bool(random.integers(2))
    if has_old_model:
        shutil.copy(folder / "elbow.onnx", model)
    old_data = model.read_bytes() if has_old_model else b""
    command = [sys.executable, "-m", "trainer", str(folder / "short recording"), str(model), *TRAINING_OPTIONS]
    has_finished = not _run_and_kill(command, float(random.uniform(0.2, 6)))
    if model.exists():
        _, data = read_model(model)
        if has_finished and has_old_model and data == old_data:
            raise CaseFailedError("the training has finished, but the file is still the old model")
    elif has_old_model or has_finished:
        raise CaseFailedError("there is no model")


def _kill_writer(folder: Path, random: np.random.Generator) -> None:
    recording = folder / "killed writing"
    shutil.rmtree(recording, ignore_errors=True)
    command = [sys.executable, "-c", WRITER_SCRIPT, str(folder / "recording"), str(recording)]
    for _ in range(3):
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        process.stdout.readline()
        try:
            process.communicate(timeout=float(random.exponential(0.05)))
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            continue
        if process.returncode:
            raise CaseFailedError(f"the recording cannot be resumed: exit status {process.returncode}")
        break
    if _run_and_kill(command, 60):
        raise CaseFailedError("the resumed recording does not end")
    read_recording(recording)
    _check_same_arrays(recording, folder / "recording")


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    """Mount an empty disk with a size in bytes; needs root.

    Raises:
        CaseFailedError: it cannot be mounted.
    """
    folder.mkdir(exist_ok=True)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mount(b"tmpfs", os.fsencode(folder), b"tmpfs", 0, f"size={size}".encode()):
        raise CaseFailedError("only root can mount a disk")
    try:
        yield folder
    finally:
        libc.umount2(os.fsencode(folder), 2)


def _run_on_small_disk(folder: Path, verb: str, random: np.random.Generator) -> None:
    max_bytes = {"record": 400e3, "train": 600e3, "bind": 2e6, "evaluate": 12e3}[verb]
    size = int(random.uniform(4096, max_bytes))
    with small_disk(folder / "small disk", size) as disk:
        # A refused recording may leave its complete poses, to be resumed.
        may_leave_files = verb == "record"
        commands = {
            "record": ("record", folder / "elbow.blend", disk / "r", "--poses", POSES),
            "train": ("train", folder / "short recording", disk / "m.onnx", *TRAINING_OPTIONS),
            "bind": ("bind", folder / "elbow.blend", folder / "elbow.onnx", disk / "b.blend"),
            "evaluate": (
                "evaluate",
                folder / "elbow.blend",
                folder / "elbow.onnx",
                "--json",
                disk / "e.json",
                "--poses",
                2,
            ),
        }
        result = subprocess.run(
            _verb_command(*commands[verb]), cwd=ROOT, capture_output=True, text=True, check=False, timeout=60
        )
        remaining_files = sorted(str(path.relative_to(disk)) for path in disk.rglob("*"))
        if result.returncode not in (0, DISK_FULL_STATUS):
            raise CaseFailedError(f"exit status {result.returncode}: {result.stderr[-300:]}")
        if "Traceback" in result.stderr + result.stdout:
            raise CaseFailedError(f"a traceback: {result.stderr[-300:]}")
        if result.returncode == DISK_FULL_STATUS:
            sentence = result.stderr.strip().splitlines()[-1]
            if not is_sentence(sentence):
                raise CaseFailedError(f"the error message is not one sentence: {sentence[:300]}")
            if remaining_files and not may_leave_files:
                raise CaseFailedError(f"the verb was refused ({sentence}) but left {remaining_files}")
