# SPDX-License-Identifier: GPL-3.0-or-later
"""Soak test of training on mutated recordings: each is refused before the training, or gives a working model."""

import json
import os
import shutil
from pathlib import Path

import numpy as np

from fdda_addon.core.recording.arrays import NPY_HEADER_ERRORS
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.runtime.network import Network
from trainer.config import TrainingConfig
from trainer.train import train_model

from .cases import CaseFailedError, print_case, run_case
from .odd_values import mutate_bytes, mutate_json, to_json_text

CONFIG = TrainingConfig(passes=1, hidden=(4,), detail_mm=0.1)
ODD_NUMBERS = np.float32([0, -1, 1e3, 1e-30, 1e30, 3e38, np.inf, -np.inf, np.nan])
MAX_MUTATED_BYTES = 1 << 30
"""A recording with a larger file is not mutated again."""


class MessageSink:
    """Receives the messages of a training and records whether it has begun."""

    def __init__(self) -> None:
        self.has_trained = False

    def send(self, message_type, **_) -> None:
        self.has_trained |= message_type.name in ("PROGRESS", "PREPARING")


def run(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Train on mutated recordings; the seed and the index of a case determine its recording."""
    (folder / "warm").mkdir(exist_ok=True)
    # The first training makes PyTorch import 165 MB, which would count as growth of the memory.
    train_model(folder / "short recording", folder / "warm" / "m.onnx", CONFIG, MessageSink())
    for case_index in range(first_case, end_case):
        random = np.random.default_rng((seed, case_index))
        recording, model = folder / "mutated", folder / "of mutated" / "m.onnx"
        for old_folder in (recording, model.parent):
            shutil.rmtree(old_folder, ignore_errors=True)
        model.parent.mkdir()
        shutil.copytree(folder / "short recording", recording)
        mutations = ", ".join(mutate_recording(random, recording) for _ in range(int(random.integers(1, 3))))
        print_case(
            run_case(
                "mutated recordings",
                f"recording {seed}/{case_index} ({mutations})",
                lambda r=recording, m=model: _train(r, m),
            )
        )


def _train(recording: Path, model: Path) -> None:
    sink = MessageSink()
    try:
        train_model(recording, model, CONFIG, sink)
    except BaseException:
        if sink.has_trained:
            raise CaseFailedError("the recording was refused after the training had begun") from None
        if written_files := [path.name for path in model.parent.iterdir()]:
            raise CaseFailedError(f"the recording was refused, but {written_files} were written") from None
        raise
    network = Network(model)
    poses = read_recording(recording).pose_matrices[:4]
    positions = network.positions(np.array(poses), np.zeros((len(poses), len(network.info.controls)), np.float32))
    if not np.isfinite(positions).all():
        raise CaseFailedError("the model outputs infinite or NaN positions")


def mutate_recording(random: np.random.Generator, recording: Path) -> str:
    """Mutate a file of a recording; return a description of the mutation."""
    files = sorted(path for path in recording.iterdir() if path.is_file() and not path.is_symlink())
    if not files:
        return "no files are left"
    if any(path.stat().st_size > MAX_MUTATED_BYTES for path in files):
        return "a sparse file stays"
    path = files[random.integers(len(files))]
    kind = random.integers(10)
    if kind < 4:
        path = recording / "recording.json"
        if not path.is_file():
            return "the index is missing"
        if random.random() < 0.15:
            path.write_bytes(mutate_bytes(random, path.read_bytes()))
            return "bytes of the index"
        try:
            value = json.loads(path.read_text())
        except ValueError:
            return "the index is not JSON"
        path.write_text(to_json_text(mutate_json(random, value)))
        return "index"
    if kind == 4:
        path.write_bytes(mutate_bytes(random, path.read_bytes()))
        return f"bytes of {path.name}"
    if kind == 5:
        return _replace_file(random, path)
    if path.suffix != ".npy":
        path.write_bytes(mutate_bytes(random, path.read_bytes()))
        return f"bytes of {path.name}"
    try:
        array = np.load(path)
    except (ValueError, EOFError, *NPY_HEADER_ERRORS):
        return f"{path.name} is no array"
    if kind == 6:
        shape = list(array.shape)
        shape[random.integers(len(shape))] = int(random.choice([0, 1, 2, 7, 100]))
        np.save(path, np.resize(array, shape))
        return f"shape of {path.name}"
    if kind == 7:
        np.save(path, array.astype(str(random.choice(["f8", "f2", "i4", "i8", "u1", ">f4", "c8", "bool"]))))
        return f"type of {path.name}"
    if kind == 8 and array.size:
        indices = random.integers(array.size, size=int(random.integers(1, 1 + min(array.size, 500))))
        if array.dtype.kind == "f":
            array.reshape(-1)[indices] = ODD_NUMBERS[random.integers(len(ODD_NUMBERS), size=len(indices))]
        else:
            array.reshape(-1)[indices] = random.choice([-1, 0, 1, 2, 1000, 2**31 - 1])
    elif array.ndim and len(array):
        # Change the order of the poses; negate the values or set them to zero.
        array = array[random.permutation(len(array))] * array.dtype.type(random.choice([1, -1, 0]))
    np.save(path, array)
    return f"values of {path.name}"


def _replace_file(random: np.random.Generator, path: Path) -> str:
    """Replace a file by a pipe, folder, link, sparse or empty file, or by nothing; return a description."""
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
        return f"{path.name} is sparse and huge"
    if kind == 4:
        path.write_bytes(b"")
        return f"{path.name} is empty"
    return f"{path.name} is missing"
