# SPDX-License-Identifier: GPL-3.0-or-later
"""Train one character for `ablation.py` without one mechanism, and measure the model on the held-out recording."""

import json
import math
import re
import statistics
import time
from pathlib import Path

import numpy as np

from benchmarks.ablation_mechanisms import ALL, MECHANISMS
from fdda_addon.core.files.output import write_json
from fdda_addon.core.formats.messages import MessageType
from fdda_addon.core.mathematics.metrics import distances, error_statistics
from fdda_addon.core.recording.index import RANDOM
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import SkinnedRecording, skin_recording
from fdda_addon.runtime.network import Network
from trainer import train
from trainer.config import TrainingConfig

CACHE_FLUSH_BYTES = 32 << 20
"""Bytes to read before each timed pose, because a frame of Blender empties the caches of the processor, too."""
TIMED_POSES = 200
BLOCK_POSES = 32
ACTION, WITHIN, BEYOND = "action", "within", "beyond"
"""Kinds of held-out poses: frames of an action, and random poses within and beyond the range of motion."""


class _SilentSink:
    def send(self, message_type: MessageType, **values) -> None:
        """Ignore a message."""


class Character:
    """A recorded character with its trainings; each is trained on the first request.

    Attributes:
        folder: folder that `ablation_recordings.py` wrote; models and results are added to it.
        held_out: recording on which models are measured.
    """

    def __init__(self, folder: Path, epochs: int):
        self.folder, self._epochs = folder, epochs
        self.held_out = skin_recording(read_recording(folder / "held_out"))
        self._build_arguments: dict[int, tuple] = {}

    def result(self, without: str, seed: int) -> dict:
        """Return the figures of a model.

        Returns:
            `seconds` of processor time of the training, 0 if only the graph was built again; `bytes` of the file;
            `frame_ratio`, time of a pose as a multiple of that of the model with all mechanisms; `errors`, for each
            kind of poses mean, 99.9th percentile and largest error as fractions of those of linear skinning.
        """
        model = self._model_path(without, seed)
        result_path = model.with_name("result.json")
        if result_path.exists():
            return json.loads(result_path.read_text(encoding="utf-8"))
        if without != ALL:
            self.result(ALL, seed)
        model.parent.mkdir(parents=True, exist_ok=True)
        start = time.process_time()
        if MECHANISMS[without].is_export:
            self._build(without, seed, model)
            seconds = 0.0
        else:
            self._train(without, seed, model)
            seconds = time.process_time() - start
        result = {
            "seconds": seconds,
            "bytes": model.stat().st_size,
            "frame_ratio": frame_ratio(model, self._model_path(ALL, seed), self.held_out),
            "errors": measure_errors(model, self.held_out),
        }
        write_json(result_path, result)
        return result

    def _model_path(self, without: str, seed: int) -> Path:
        name = re.sub("[^a-z0-9]+", "-", without.lower())
        return self.folder / f"{name}-epochs{self._epochs}-seed{seed}" / "model.onnx"

    def _train(self, without: str, seed: int, model: Path) -> None:
        mechanism = MECHANISMS[without]
        config = TrainingConfig(passes=self._epochs, seed=seed)
        build_model = train.build_model

        def keep_arguments(*arguments):
            if without == ALL:
                self._build_arguments[seed] = arguments
            return build_model(*arguments)

        train.build_model = keep_arguments
        try:
            with mechanism.switched_off():
                train.train_model(self.folder / "recording", model, config, _SilentSink())
        finally:
            train.build_model = build_model

    def _build(self, without: str, seed: int, model: Path) -> None:
        """Build the graph of the trained model again, without a mechanism of the export."""
        if seed not in self._build_arguments:
            self._train(ALL, seed, self._model_path(ALL, seed))
        with MECHANISMS[without].switched_off():
            model.write_bytes(train.build_model(*self._build_arguments[seed]).content)


def kinds_of_poses(recording: SkinnedRecording) -> dict[str, np.ndarray]:
    """Return the indices of the poses of each kind that a held-out recording has."""
    is_random = np.concatenate([np.full(s.poses, s.kind == RANDOM) for s in recording.info.sampling.sources])
    random, overshoot = np.flatnonzero(is_random), recording.info.sampling.overshoot
    within, beyond = np.split(random, [len(random) - (overshoot.poses if overshoot else 0)])
    kinds = {ACTION: np.flatnonzero(~is_random), WITHIN: within, BEYOND: beyond}
    return {kind: poses for kind, poses in kinds.items() if len(poses)}


def measure_errors(model: Path, held_out: SkinnedRecording) -> dict[str, list[float]]:
    """Return mean, 99.9th percentile and largest error of each kind of poses, as fractions of linear skinning's."""
    network, skinning = Network(model), held_out.skinning
    result = {}
    for kind, poses in kinds_of_poses(held_out).items():
        errors: tuple[list, list] = ([], [])
        for start in range(0, len(poses), BLOCK_POSES):
            block = poses[start : start + BLOCK_POSES]
            matrices, controls = held_out.pose_matrices[block], held_out.controls[block]
            true_positions = held_out.read_positions(block)
            positions = (network.positions(matrices, controls), skinning.positions(matrices))
            for method_positions, kept in zip(positions, errors, strict=True):
                kept.append(distances(method_positions, true_positions, held_out.rig.metres_per_unit))
        of_model, of_skinning = (error_statistics(np.concatenate(blocks)) for blocks in errors)
        pairs = [(getattr(of_model, name), getattr(of_skinning, name)) for name in ("mean", "p999", "max")]
        result[kind] = [value / reference for value, reference in pairs]
    return result


def frame_ratio(model: Path, reference: Path, held_out: SkinnedRecording) -> float:
    """Return the median time of a pose of a model, as a multiple of that of another; both run in turns.

    The model that is loaded first takes 5 to 12 % longer, so each is first once.
    """
    first, second = (_median_times(pair, held_out) for pair in ((model, reference), (reference, model)))
    return math.sqrt(first[0] / first[1] * second[1] / second[0])


def _median_times(models: tuple[Path, Path], held_out: SkinnedRecording) -> tuple[float, float]:
    """Return the median seconds of a pose of two models that run in turns."""
    networks, other_memory = [Network(model) for model in models], np.ones(CACHE_FLUSH_BYTES // 4, np.float32)
    times: tuple[list[float], list[float]] = ([], [])
    for index in range(TIMED_POSES):
        row = slice(index % len(held_out.pose_matrices), index % len(held_out.pose_matrices) + 1)
        matrices, controls = np.array(held_out.pose_matrices[row]), np.array(held_out.controls[row])
        # Each is first in half of the turns.
        for which in (0, 1) if index % 2 else (1, 0):
            other_memory.sum()
            start = time.perf_counter()
            networks[which].positions(matrices, controls)
            times[which].append(time.perf_counter() - start)
    return statistics.median(times[0]), statistics.median(times[1])
