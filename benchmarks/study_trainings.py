# SPDX-License-Identifier: GPL-3.0-or-later
"""Train some partitions of a recording for `study.py`, with the steps of the trainer; keep the results in a folder."""

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
from trainer.config import TrainingConfig
from trainer.data.split import split_poses
from trainer.export.export import Measurement, build_model, measure, write_model
from trainer.inputs.block import State
from trainer.inputs.controls import ControlFeatures
from trainer.inputs.joints import JointFeatures
from trainer.inputs.network_inputs import NetworkInputs, fit_inputs
from trainer.inputs.surface_frames import SurfaceFrameFeatures
from trainer.model import TrainedModel, make_trained_model
from trainer.networks.loop import train
from trainer.preparation import partition_data, prepare_partition


@dataclass(frozen=True)
class StudyData:
    """Data that all trainings share.

    Attributes:
        whole_training: the training recording with all partitions.
        training, held_out: both recordings with only the partitions of the study.
    """

    whole_training: Recording
    training: Recording
    held_out: Recording


def select_partitions(recording: Recording, names: tuple[str, ...]) -> Recording:
    """Return a copy of a recording with only the named partitions; their vertices keep their order.

    Raises:
        RecordingError: the recording has no partition of that name.
    """
    rig = recording.rig
    partitions_by_name = {rig.joints[partition.joint].name: partition for partition in recording.partitions}
    if missing := [name for name in names if name not in partitions_by_name]:
        raise RecordingError(
            f"'{recording.path}' has no partition '{missing[0]}'; it has {', '.join(partitions_by_name)}."
        )
    selected = [partitions_by_name[name] for name in names]
    vertices = np.sort(np.concatenate([partition.vertices for partition in selected]))
    small_rig = Rig(
        rig.joints,
        rig.rest_positions[vertices],
        rig.rest_matrices,
        rig.skin_joints[vertices],
        rig.skin_weights[vertices],
        rig.fingerprint,
        controls=rig.controls,
    )
    partitions = read_partitions(small_rig, partitions_to_json(tuple(selected)))
    residuals = np.array(recording.residuals[:, vertices])
    return Recording(
        recording.path, recording.info, small_rig, partitions, recording.pose_matrices, residuals, recording.controls
    )


def read_study_data(training: Path, held_out: Path, names: tuple[str, ...]) -> StudyData:
    """Read both recordings and select the partitions.

    Raises:
        RecordingError: the recordings are of different rigs or of the same poses, or have no partition of a name.
    """
    whole_training, whole_held_out = read_recording(training), read_recording(held_out)
    if (
        whole_training.rig.fingerprint != whole_held_out.rig.fingerprint
        or whole_training.rig.joints != whole_held_out.rig.joints
    ):
        raise RecordingError(
            f"'{held_out}' is a recording of a different rig than '{training}'; record both from the same file."
        )
    if whole_training.info.sampling.seed == whole_held_out.info.sampling.seed:
        raise RecordingError(
            f"'{held_out}' has seed {whole_held_out.info.sampling.seed}, like '{training}', "
            "so its poses are not held-out poses; "
            "record it with another --seed."
        )
    training_data = select_partitions(whole_training, names)
    return StudyData(whole_training, training_data, select_partitions(whole_held_out, names))


def make_study_inputs(study_data: StudyData, states: dict[str, State]) -> NetworkInputs:
    """Make the inputs of the partitions as in a training of the whole character."""
    whole, partitions = study_data.whole_training, study_data.training.partitions
    surface_frames = SurfaceFrameFeatures.make(whole.rig, whole.partitions, states.get(SurfaceFrameFeatures.name, {}))
    is_selected = np.isin(surface_frames.main_joints, [partition.joint for partition in partitions])
    blocks = (
        JointFeatures.make(whole.rig, partitions, {}),
        ControlFeatures.make(whole.rig, partitions, {}),
        surface_frames.subset(is_selected),
    )
    return NetworkInputs.of(blocks, partitions)


def train_once(study_data: StudyData, config: TrainingConfig, model_path: Path) -> dict:
    """Train, export and measure one configuration; write its model and return its entry of study.json."""
    recording = study_data.training
    wall_start, processor_start = time.perf_counter(), time.process_time()
    split = split_poses(np.arange(len(recording.pose_matrices)), config.validation_fraction, config.seed)
    inputs = make_study_inputs(study_data, fit_inputs(study_data.whole_training, split, config))
    data = partition_data(recording, inputs)
    prepared = [prepare_partition(partition, split, config.tolerance_mm, config.seed) for partition in data]
    trained = train(prepared, split, config, torch.device("cpu"))
    seconds = {"processor": time.process_time() - processor_start, "wall": time.perf_counter() - wall_start}
    trained_model = make_trained_model(recording, inputs, split, trained)
    exported = build_model(recording, trained_model, split.validation, config.to_json())
    held_out = measure(exported.session, study_data.held_out, np.arange(len(study_data.held_out.pose_matrices)))
    with atomic_write(model_path) as temporary:
        write_model(temporary, exported.content)
    return {
        "seconds": {key: round(value, 2) for key, value in seconds.items()},
        "model_bytes": len(exported.content),
        "parameters": sum(a.size for p in trained for a in (*p.network.weights, *p.network.biases)),
        "partitions": {
            recording.rig.joint_names[trained_model.partitions[index].joint]: {
                "basis_left": {
                    "validation": float(partition.validation_truncation.mean()) * 1000,
                    "held_out": _truncation_error_mm(trained_model, index, study_data.held_out),
                },
                **_partition_entry(trained_model, index, exported.held_out, held_out),
            }
            for index, partition in enumerate(trained)
        },
    }


def _partition_entry(trained_model: TrainedModel, index: int, validation: Measurement, held_out: Measurement) -> dict:
    vertices, curves = trained_model.partitions[index].vertices, trained_model.prepared[index].curves

    def errors(distances: np.ndarray) -> dict:
        return error_statistics(distances[:, vertices]).to_json()

    return {
        "vertices": len(vertices),
        "features": len(trained_model.prepared[index].columns),
        "basis": len(trained_model.prepared[index].basis.components),
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


def _truncation_error_mm(trained_model: TrainedModel, index: int, recording: Recording) -> float:
    """Return the mean error with the best coefficients of the basis, mm: the error of a network without error."""
    partition, prepared = trained_model.partitions[index], trained_model.prepared[index]
    skin = skin_matrices(recording.pose_matrices, recording.rig.rest_matrices).astype(np.float64)
    fitted = prepared.fit.compute_offsets(skin) @ np.linalg.inv(skin[:, partition.joint, :3, :3]).transpose(0, 2, 1)
    residuals = (recording.residuals[:, partition.vertices] - fitted).reshape(len(skin), -1).astype(np.float32)
    truncation = prepared.basis.reconstruct(prepared.basis.project(residuals)) - residuals
    return error_statistics(np.linalg.norm(truncation.reshape(fitted.shape), axis=2)).mean


def validation_score(training: dict) -> float:
    """Return validation error / error of linear skinning, mean over the partitions; it chooses the learning rate."""
    partitions = training["partitions"].values()
    return float(np.mean([p["validation"]["mean"] / p["validation_linear"]["mean"] for p in partitions]))


class Trainings:
    """The trainings in a folder; each is trained on the first request.

    Attributes:
        trained_count: number of trainings in this process; the others were in the folder.
    """

    def __init__(self, study_data: StudyData, folder: Path, report: Callable[[str], None]):
        self.study_data, self.folder, self.report, self.trained_count = study_data, folder, report, 0
        folder.mkdir(parents=True, exist_ok=True)
        self.origin = [
            {**asdict(r.rig.fingerprint), "poses": r.info.poses, "seed": r.info.sampling.seed}
            for r in (study_data.training, study_data.held_out)
        ]

    def get(self, config: TrainingConfig) -> dict:
        """Return the result of `train_once` for a configuration, with the name of the model file as `model`."""
        units, layers = config.hidden[0], len(config.hidden)
        name = f"{units}x{layers}-{config.activation}-{config.learning_rate:g}-seed{config.seed}"
        model_path, notes_path = self.folder / f"{name}.onnx", self.folder / f"{name}.json"
        origin = {"settings": config.to_json(), "recordings": self.origin}
        if model_path.exists() and notes_path.exists():
            saved_entry = json.loads(notes_path.read_text(encoding="utf-8"))
            # Train again if other poses or epochs have the same name.
            if saved_entry.pop("origin") == origin:
                return saved_entry
        try:
            if not self.trained_count:
                # Train one epoch untimed, because torch loads modules in the first training of a process.
                train_once(self.study_data, replace(config, epochs=1), model_path)
            training = train_once(self.study_data, config, model_path)
        except TrainingError as error:
            raise TrainingError(f"{name}: {error}") from error
        self.trained_count += 1
        training |= {"model": model_path.name}
        write_json(notes_path, training | {"origin": origin})
        self.report(f"{name}: {100 * validation_score(training):.2f} %, {training['seconds']['wall']:.1f} s")
        return training
