# SPDX-License-Identifier: GPL-3.0-or-later
"""Kills and full disks: what was complete is so, what resumes is bit-identical, what was there before still is."""

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

from fdda_addon.core.model import read_model
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import read_recording

from .cases import ShortfallError, attempt, is_sentence, say

ROOT = Path(__file__).resolve().parents[2]
POSES = 40
TRAINING = ("--epochs", "3", "--hidden", "4", "4")
KINDS = ("record", "train", "write")
DISKS = ("record", "train", "bind", "evaluate")
NO_ROOM = 75
WRITE = """
import sys
from pathlib import Path
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter
source, path = map(Path, sys.argv[1:])
found = read_recording(source)
print("ready", flush=True)
with RecordingWriter(path, found.rig, found.partitions, found.info, resume=path.exists()) as writer:
    while writer.complete < len(found.pose_matrices):
        part = slice(writer.complete, writer.complete + 1)
        writer.append(found.pose_matrices[part], found.residuals[part])
"""


def run_kills(folder: Path, seed: int, first: int, end: int) -> None:
    """Kill verbs at random moments and go on."""
    for number in range(first, end):
        random, kind = np.random.default_rng((seed, number)), KINDS[number % len(KINDS)]
        action = {"record": _kill_record, "train": _kill_train, "write": _kill_writer}[kind]
        say(attempt("kills", f"kill {seed}/{number} ({kind})", lambda a=action, r=random: a(folder, r)))


def run_full_disks(folder: Path, seed: int, first: int, end: int) -> None:
    """Run verbs on disks of random sizes."""
    for number in range(first, end):
        random, verb = np.random.default_rng((seed, number)), DISKS[number % len(DISKS)]
        say(attempt("full disks", f"full disk {seed}/{number} ({verb})", lambda v=verb, r=random: _fill(folder, v, r)))


def _command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "fdda_addon", *map(str, arguments)]


def _killed(command: list[str], seconds: float) -> bool:
    """Start a process and kill it after so many seconds; whether it was still at work."""
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        output, _ = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.communicate()
        return True
    if process.returncode:
        raise ShortfallError(f"exit status {process.returncode}: {output.decode()[-300:]}")
    return False


def _same_arrays(recording: Path, whole: Path) -> None:
    for path in whole.glob("*.npy"):
        if path.read_bytes() != (recording / path.name).read_bytes():
            raise ShortfallError(f"{path.name} is not what one run records")


def _kill_record(folder: Path, random: np.random.Generator) -> None:
    recording = folder / "killed recording"
    shutil.rmtree(recording, ignore_errors=True)
    for _ in range(3):
        if recording.exists() and (recording / "recording.json").exists():
            read_index(recording)
        resume = ("--resume",) if recording.exists() else ()
        command = _command("record", folder / "elbow.blend", recording, "--poses", POSES, *resume)
        if not _killed(command, float(random.uniform(0.5, 2.5))):
            break
    if not (recording / "recording.json").exists() or read_index(recording)["complete"] < POSES:
        resume = ("--resume",) if recording.exists() else ()
        command = _command("record", folder / "elbow.blend", recording, "--poses", POSES, *resume)
        if _killed(command, 60):
            raise ShortfallError("the resumed recording does not end")
    read_recording(recording)
    _same_arrays(recording, folder / "short recording")


def _kill_train(folder: Path, random: np.random.Generator) -> None:
    place = folder / "killed training"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    model = place / "m.onnx"
    had = bool(random.integers(2))
    if had:
        shutil.copy(folder / "elbow.onnx", model)
    before = model.read_bytes() if had else b""
    command = [sys.executable, "-m", "trainer", str(folder / "short recording"), str(model), *TRAINING]
    finished = not _killed(command, float(random.uniform(0.2, 6)))
    if model.exists():
        _, data = read_model(model)
        if finished and had and data == before:
            raise ShortfallError("it has finished and the model is the old one")
    elif had or finished:
        raise ShortfallError("the model is gone")


def _kill_writer(folder: Path, random: np.random.Generator) -> None:
    recording = folder / "killed writing"
    shutil.rmtree(recording, ignore_errors=True)
    command = [sys.executable, "-c", WRITE, str(folder / "recording"), str(recording)]
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
            raise ShortfallError(f"it cannot be gone on with: exit status {process.returncode}")
        break
    if _killed(command, 60):
        raise ShortfallError("the resumed recording does not end")
    read_recording(recording)
    _same_arrays(recording, folder / "recording")


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    """A disk of its own of so many bytes; needs root.

    Raises:
        ShortfallError: it cannot be mounted.
    """
    folder.mkdir(exist_ok=True)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mount(b"tmpfs", os.fsencode(folder), b"tmpfs", 0, f"size={size}".encode()):
        raise ShortfallError("no disk can be mounted here: only root may")
    try:
        yield folder
    finally:
        libc.umount2(os.fsencode(folder), 2)


def _fill(folder: Path, verb: str, random: np.random.Generator) -> None:
    largest = {"record": 400e3, "train": 600e3, "bind": 2e6, "evaluate": 12e3}[verb]
    size = int(random.uniform(4096, largest))
    with small_disk(folder / "small disk", size) as disk:
        old = {"record": None, "train": disk / "m.onnx", "bind": disk / "b.blend", "evaluate": disk / "e.json"}[verb]
        commands = {
            "record": ("record", folder / "elbow.blend", disk / "r", "--poses", POSES),
            "train": ("train", folder / "short recording", disk / "m.onnx", *TRAINING),
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
            _command(*commands[verb]), cwd=ROOT, capture_output=True, text=True, check=False, timeout=60
        )
        left = sorted(str(path.relative_to(disk)) for path in disk.rglob("*"))
        if result.returncode not in (0, NO_ROOM):
            raise ShortfallError(f"exit status {result.returncode}: {result.stderr[-300:]}")
        if "Traceback" in result.stderr + result.stdout:
            raise ShortfallError(f"a traceback: {result.stderr[-300:]}")
        if result.returncode == NO_ROOM:
            sentence = result.stderr.strip().splitlines()[-1]
            if not is_sentence(sentence):
                raise ShortfallError(f"no sentence: {sentence[:300]}")
            if old is not None and left:
                raise ShortfallError(f"it is refused ({sentence}) and leaves {left}")
