# SPDX-License-Identifier: GPL-3.0-or-later
"""The trainings of `study.py`: parts of a recording, through the trainer's own steps, kept in a folder."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from fdda_addon.core.errors import RecordingError, TrainingError
from fdda_addon.core.metrics import error_statistics
from fdda_addon.core.output import atomic_write, write_json
from fdda_addon.core.recording.reader import Recording, partitions_to_json, read_partitions, read_recording
from fdda_addon.core.rig import Rig
from fdda_addon.core.skinning import skin_matrices
from trainer.confidence import measure_training_range
from trainer.config import TrainingConfig
from trainer.curves import Curves
from trainer.data import partition_data, prepare_partition
from trainer.export import PositionErrors, build_model, measure, write_model
from trainer.inputs import NetworkInputs, inputs_of_rig, partition_centers
from trainer.loop import train
from trainer.splitting import split_poses
from trainer.surface_frame_fit import select_surface_frames
from trainer.trained_model import TrainedModel, is_sheared


@dataclass(frozen=True)
class Material:
    """What every training shares.

    Attributes:
        whole: the training recording.
        training, held_out: both recordings, cut down to the partitions.
        inputs: of the networks, without surface frames, which depend on the split.
    """

    whole: Recording
    training: Recording
    held_out: Recording
    inputs: NetworkInputs


def cut(recording: Recording, names: tuple[str, ...]) -> Recording:
    """A recording of some partitions alone; their vertices keep their order.

    Raises:
        RecordingError: it has no such partition.
    """
    rig = recording.rig
    own = {rig.joints[partition.joint].name: partition for partition in recording.partitions}
    if missing := [name for name in names if name not in own]:
        raise RecordingError(f"'{recording.path}' has no partition '{missing[0]}'; it has {', '.join(own)}.")
    chosen = [own[name] for name in names]
    vertices = np.sort(np.concatenate([partition.vertices for partition in chosen]))
    small = Rig(
        rig.joints,
        rig.rest_positions[vertices],
        rig.rest_matrices,
        rig.skin_joints[vertices],
        rig.skin_weights[vertices],
        rig.fingerprint,
        controls=rig.controls,
    )
    partitions = read_partitions(small, partitions_to_json(tuple(chosen)))
    residuals = np.array(recording.residuals[:, vertices])
    return Recording(
        recording.path, recording.info, small, partitions, recording.pose_matrices, residuals, recording.controls
    )


def read_material(training: Path, held_out: Path, names: tuple[str, ...]) -> Material:
    """Read both recordings.

    Raises:
        RecordingError: they are of different rigs or of the same poses, or lack a partition.
    """
    whole, other = read_recording(training), read_recording(held_out)
    if whole.rig.fingerprint != other.rig.fingerprint or whole.rig.joints != other.rig.joints:
        raise RecordingError(f"'{held_out}' is of another rig than '{training}'; record both of the same file.")
    if whole.info.sampling.seed == other.info.sampling.seed:
        raise RecordingError(
            f"'{held_out}' has seed {other.info.sampling.seed}, as '{training}' has: its poses are no held-out ones; "
            "record it with another --seed."
        )
    small = cut(whole, names)
    # The centers of neighbors are those of the whole mesh, as when all partitions train.
    inputs = inputs_of_rig(whole.rig, partition_centers(whole.rig, whole.partitions), small.partitions)
    return Material(whole, small, cut(other, names), inputs)


def train_once(material: Material, config: TrainingConfig, model_path: Path) -> dict:
    """Train, export and measure; writes the model and returns what is known of it, as docs/experiments.md has it."""
    recording = material.training
    wall, processor = time.perf_counter(), time.process_time()
    split = split_poses(np.arange(len(recording.pose_matrices)), config.validation_fraction, config.seed)
    # Chosen among those of all partitions, as when all of them train.
    surface_frames = select_surface_frames(material.whole, split, config.tolerance_mm)
    own = np.isin(surface_frames.main_joints, [partition.joint for partition in recording.partitions])
    inputs = material.inputs.with_surface_frames(surface_frames.subset(own), recording.partitions)
    data = partition_data(recording, recording.partitions, inputs)
    prepared = [prepare_partition(partition, split, config.tolerance_mm, config.seed) for partition in data]
    trained = train(prepared, split, config, torch.device("cpu"))
    seconds = {"processor": time.process_time() - processor, "wall": time.perf_counter() - wall}
    poses, controls = (np.array(a[split.training]) for a in (recording.pose_matrices, recording.controls))
    seen = inputs.features(poses, recording.rig.rest_matrices, controls)
    training_range = measure_training_range(seen, recording.rig, recording.partitions)
    trained_model = TrainedModel(
        recording.rig,
        recording.partitions,
        inputs,
        tuple(prepared),
        trained.networks,
        training_range,
        config.activation,
        is_sheared(recording.pose_matrices),
    )
    exported = build_model(recording, trained_model, split.validation, config.to_json())
    held_out = measure(
        exported.session, material.held_out, trained_model, np.arange(len(material.held_out.pose_matrices))
    )
    with atomic_write(model_path) as temporary:
        write_model(temporary, exported.content)
    return {
        "seconds": {key: round(value, 2) for key, value in seconds.items()},
        "model_bytes": len(exported.content),
        "parameters": sum(a.size for network in trained.networks for a in (*network.weights, *network.biases)),
        "partitions": {
            prepared[n].name: {
                "basis_left": {
                    "validation": float(prepared[n].validation_truncation.mean()) * 1000,
                    "held_out": _basis_left(trained_model, n, material.held_out),
                },
                **_partition(trained_model, n, exported.held_out, held_out, curves),
            }
            for n, curves in enumerate(trained.curves)
        },
    }


def _partition(
    trained_model: TrainedModel, number: int, validation: PositionErrors, held_out: PositionErrors, curves: Curves
) -> dict:
    vertices = trained_model.partitions[number].vertices

    def errors(distances: np.ndarray) -> dict:
        return error_statistics(distances[:, vertices]).to_json()

    return {
        "vertices": len(vertices),
        "features": len(trained_model.prepared[number].columns),
        "basis": trained_model.component_counts()[number],
        "validation": errors(validation.fdda),
        "validation_linear": errors(validation.linear),
        "held_out": errors(held_out.fdda),
        "held_out_linear": errors(held_out.linear),
        "curve": {
            "training": [round(value, 6) for value in curves.training_mm],
            "validation": [round(value, 6) for value in curves.validation_mm],
            "best_epoch": curves.best_epoch,
        },
    }


def _basis_left(trained_model: TrainedModel, number: int, recording: Recording) -> float:
    """Mean distance that the basis leaves where its best coefficients are known, mm: what a perfect network leaves."""
    partition, prepared = trained_model.partitions[number], trained_model.prepared[number]
    skin = skin_matrices(recording.pose_matrices, recording.rig.rest_matrices).astype(np.float64)
    fitted = prepared.fit.offsets(skin) @ np.linalg.inv(skin[:, partition.joint, :3, :3]).transpose(0, 2, 1)
    learned = (recording.residuals[:, partition.vertices] - fitted).reshape(len(skin), -1).astype(np.float32)
    left = prepared.basis.residuals(prepared.basis.coefficients(learned)) - learned
    return error_statistics(np.linalg.norm(left.reshape(fitted.shape), axis=2)).mean


def validation_score(training: dict) -> float:
    """What a learning rate is chosen by: validation error as a part of linear skinning's, mean over the partitions."""
    partitions = training["partitions"].values()
    return float(np.mean([p["validation"]["mean"] / p["validation_linear"]["mean"] for p in partitions]))


class Trainings:
    """The trainings in a folder, each made when it is first asked for.

    Attributes:
        made: how many were trained, the others were there already.
    """

    def __init__(self, material: Material, folder: Path, say: Callable[[str], None]):
        self.material, self.folder, self.say, self.made = material, folder, say, 0
        folder.mkdir(parents=True, exist_ok=True)
        self.origin = [
            {**asdict(r.rig.fingerprint), "poses": r.info.poses, "seed": r.info.sampling.seed}
            for r in (material.training, material.held_out)
        ]

    def get(self, config: TrainingConfig) -> dict:
        """What `train_once` says of a configuration; `model` is the name of the model in the folder."""
        units, layers = config.hidden[0], len(config.hidden)
        name = f"{units}x{layers}-{config.activation}-{config.learning_rate:g}-seed{config.seed}"
        model, notes = self.folder / f"{name}.onnx", self.folder / f"{name}.json"
        origin = {"settings": config.to_json(), "recordings": self.origin}
        if model.exists() and notes.exists():
            known = json.loads(notes.read_text(encoding="utf-8"))
            # Other poses or epochs under the same name: train again.
            if known.pop("origin") == origin:
                return known
        try:
            if not self.made:
                # The first training of a process pays for what torch loads then.
                train_once(self.material, replace(config, epochs=1), model)
            training = train_once(self.material, config, model)
        except TrainingError as error:
            raise TrainingError(f"{name}: {error}") from error
        self.made += 1
        training |= {"model": model.name}
        write_json(notes, training | {"origin": origin})
        self.say(f"{name}: {100 * validation_score(training):.2f} %, {training['seconds']['wall']:.1f} s")
        return training
