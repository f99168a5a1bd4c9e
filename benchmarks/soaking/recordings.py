# SPDX-License-Identifier: GPL-3.0-or-later
"""Mutated recordings, trained: each is refused in a sentence before any training, or gives a model that is in order."""

import json
import os
import shutil
from pathlib import Path

import numpy as np

from fdda_addon.core.recording.arrays import NPY_HEADER_ERRORS
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.runtime.network import Network
from trainer.config import TrainingConfig
from trainer.training import train_model

from .cases import ShortfallError, attempt, say
from .odd_values import mutated_bytes, mutated_json, to_json_text

CONFIG = TrainingConfig(epochs=1, hidden=(4,), tolerance_mm=0.1)
NUMBERS = np.float32([0, -1, 1e3, 1e-30, 1e30, 3e38, np.inf, -np.inf, np.nan])
LARGEST = 1 << 30
"""Bytes of a file in a recording that is changed once more."""


class Silent:
    """Hears what a training says, and notes whether it has begun."""

    def __init__(self) -> None:
        self.has_trained = False

    def send(self, kind, **_) -> None:
        self.has_trained |= kind.name in ("PROGRESS", "PREPARING")


def run(folder: Path, seed: int, first: int, end: int) -> None:
    """Train the recordings of some numbers, the same for the same seed and number."""
    (folder / "warm").mkdir(exist_ok=True)
    # PyTorch imports 165 MB with the first training, and not again.
    train_model(folder / "short recording", folder / "warm" / "m.onnx", CONFIG, Silent())
    for number in range(first, end):
        random = np.random.default_rng((seed, number))
        recording, model = folder / "mutated", folder / "of mutated" / "m.onnx"
        for old in (recording, model.parent):
            shutil.rmtree(old, ignore_errors=True)
        model.parent.mkdir()
        shutil.copytree(folder / "short recording", recording)
        how = ", ".join(mutate(random, recording) for _ in range(int(random.integers(1, 3))))
        say(
            attempt(
                "mutated recordings", f"recording {seed}/{number} ({how})", lambda r=recording, m=model: _train(r, m)
            )
        )


def _train(recording: Path, model: Path) -> None:
    sink = Silent()
    try:
        train_model(recording, model, CONFIG, sink)
    except BaseException:
        if sink.has_trained:
            raise ShortfallError("it is refused after the training has begun") from None
        if left := [path.name for path in model.parent.iterdir()]:
            raise ShortfallError(f"it is refused and leaves {left}") from None
        raise
    network = Network(model)
    poses = read_recording(recording).pose_matrices[:4]
    positions = network.positions(np.array(poses), np.zeros((len(poses), len(network.info.controls)), np.float32))
    if not np.isfinite(positions).all():
        raise ShortfallError("the model gives positions that are not numbers")


def mutate(random: np.random.Generator, recording: Path) -> str:
    """Change something of a recording; says what."""
    files = sorted(path for path in recording.iterdir() if path.is_file() and not path.is_symlink())
    if not files:
        return "nothing is left"
    if any(path.stat().st_size > LARGEST for path in files):
        return "what is hollow stays so"
    path = files[random.integers(len(files))]
    kind = random.integers(10)
    if kind < 4:
        path = recording / "recording.json"
        if not path.is_file():
            return "the index is gone"
        if random.random() < 0.15:
            path.write_bytes(mutated_bytes(random, path.read_bytes()))
            return "bytes of the index"
        try:
            value = json.loads(path.read_text())
        except ValueError:
            return "the index is none"
        path.write_text(to_json_text(mutated_json(random, value)))
        return "index"
    if kind == 4:
        path.write_bytes(mutated_bytes(random, path.read_bytes()))
        return f"bytes of {path.name}"
    if kind == 5:
        return _other_kind(random, path)
    if path.suffix != ".npy":
        path.write_bytes(mutated_bytes(random, path.read_bytes()))
        return f"bytes of {path.name}"
    try:
        array = np.load(path)
    except (ValueError, EOFError, *NPY_HEADER_ERRORS):
        return f"{path.name} is none"
    if kind == 6:
        shape = list(array.shape)
        shape[random.integers(len(shape))] = int(random.choice([0, 1, 2, 7, 100]))
        np.save(path, np.resize(array, shape))
        return f"shape of {path.name}"
    if kind == 7:
        np.save(path, array.astype(str(random.choice(["f8", "f2", "i4", "i8", "u1", ">f4", "c8", "bool"]))))
        return f"type of {path.name}"
    if kind == 8 and array.size:
        places = random.integers(array.size, size=int(random.integers(1, 1 + min(array.size, 500))))
        if array.dtype.kind == "f":
            array.reshape(-1)[places] = NUMBERS[random.integers(len(NUMBERS), size=len(places))]
        else:
            array.reshape(-1)[places] = random.choice([-1, 0, 1, 2, 1000, 2**31 - 1])
    elif array.ndim and len(array):
        # Poses in another order, a matrix that mirrors or is flat.
        array = array[random.permutation(len(array))] * array.dtype.type(random.choice([1, -1, 0]))
    np.save(path, array)
    return f"values of {path.name}"


def _other_kind(random: np.random.Generator, path: Path) -> str:
    path.unlink()
    kind = random.integers(6)
    if kind == 0:
        os.mkfifo(path)
        return f"{path.name} is a pipe"
    if kind == 1:
        path.mkdir()
        return f"{path.name} is a folder"
    if kind == 2:
        path.symlink_to(str(random.choice(["/dev/zero", "/dev/stdin", "/etc/passwd", "nowhere", path.name])))
        return f"{path.name} is a link"
    if kind == 3:
        with open(path, "wb") as file:
            file.truncate(1 << 40)
        return f"{path.name} is hollow and huge"
    if kind == 4:
        path.write_bytes(b"")
        return f"{path.name} is empty"
    return f"{path.name} is gone"
