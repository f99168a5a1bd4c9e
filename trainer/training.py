# SPDX-License-Identifier: GPL-3.0-or-later
"""One training, from the recording to the files that it leaves."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from fdda_addon.core.checks.recording import check_recording
from fdda_addon.core.checks.warning import RecordingWarning, refuse
from fdda_addon.core.errors import TrainingError
from fdda_addon.core.messages import MessageType
from fdda_addon.core.output import atomic_write_all
from fdda_addon.core.partition import Partition
from fdda_addon.core.recording.estimate import training_size_sentence
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.core.report import checkpoint_path, report_text
from fdda_addon.core.rig import STATIC_JOINT_LABEL

from . import report
from .announcements import Announcer
from .borders import better_borders, partition_of
from .checkpoint import Checkpoint, initial_networks, read_checkpoint, write_checkpoint
from .confidence import measure_training_range
from .config import TrainingConfig
from .data import PreparedPartition, Split, held_back_digest, partitions_of, prepare_together, split_recording
from .deformation import Deformation, is_sheared
from .delta_fit import find_deltas
from .export import build_model, measure, measure_surface, write_model
from .goal import GoalResult, evaluate_goal
from .inputs import Inputs, inputs_with_deltas
from .loop import Trained, choose_device, train
from .outputs import check_training_outputs, training_outputs
from .page import render_html
from .process import Cancelled
from .sagging import without_needless_down
from .turns import turns_help
from .worst import find_worst

WARM_EPOCHS, WARM_RATE = 0.5, 0.3
"""A warm start takes this part of the epochs and of the learning rate: most is learned already."""


def train_model(
    recording_path: Path,
    model_path: Path,
    config: TrainingConfig,
    announcer: Announcer,
    should_stop: Callable[[], bool] = lambda: False,
    warm_start: bool = False,
    strict: bool = False,
    overwrite: bool = False,
) -> None:
    """Train a model, and write it with its report and its checkpoint beside it.

    Args:
        recording_path: folder of a complete recording.
        model_path: the .onnx file; it and the report are written when everything else is done.
        config: the settings.
        announcer: told everything from `STARTED` to `FINISHED`; not told of errors.
        should_stop: asked often; nothing has been written when it is heeded.
        warm_start: start from the checkpoint of the model, on a recording that may have grown since.
        strict: warnings about the recording are errors.
        overwrite: write over files of another kind.

    Raises:
        Cancelled: `should_stop` said so.
        FDDAError: the recording, the settings or the output path are no good.
    """
    started = time.perf_counter()
    check_training_outputs(model_path, overwrite)
    recording = read_recording(recording_path)
    split = split_recording(recording, config)
    held_back = held_back_digest(recording, split)
    checkpoint = _initial_checkpoint(model_path, recording, held_back, config) if warm_start else None
    device = choose_device()
    announcer.say(
        MessageType.STARTED,
        partitions=len(recording.partitions),
        poses=len(recording.pose_matrices),
        vertices=recording.rig.vertex_count,
        device=str(device),
    )
    announcer.say(MessageType.LOG, text=training_size_sentence(recording))
    warnings = _check(recording, announcer, strict)
    _check_stop(should_stop)
    recording = without_needless_down(recording, split)
    # What is gone on with goes on to see the same.
    deltas = checkpoint.deltas if checkpoint else find_deltas(recording, split, config.tolerance_mm, should_stop)
    if len(deltas):
        announcer.say(MessageType.LOG, text=f"The rig smooths: networks see the deltas of {len(deltas)} vertices.")
    # Deltas say what turns would, and more.
    turns = not len(deltas) and turns_help(recording, split.training, should_stop)
    if turns:
        announcer.say(MessageType.LOG, text="The rig blends rotations: residuals are fitted to turns of joints, too.")
    if checkpoint:
        partitions = checkpoint.cut(recording.partitions)
    else:
        partitions = better_borders(recording, split, turns, config.tolerance_mm, config.hidden[-1], should_stop)
    if moved := int((partition_of(partitions) != partition_of(recording.partitions)).sum()):
        announcer.say(MessageType.LOG, text=f"Borders moved: {moved} vertices count to the partition beside their own.")
    inputs = inputs_with_deltas(recording.rig, partitions, deltas)
    prepared = _prepare(recording, partitions, inputs, turns, split, config, announcer, should_stop)
    seen = [columns[partition.columns] for columns, partition in zip(inputs.columns, prepared, strict=True)]
    trained = train(
        prepared,
        split,
        _shorter(config) if checkpoint else config,
        device,
        lambda p: announcer.say(
            MessageType.PROGRESS,
            epoch=p.epoch,
            epochs=p.epochs,
            training_mm=round(p.training_mm, 6),
            validation_mm=round(p.validation_mm, 6),
        ),
        should_stop,
        initial_networks(checkpoint, prepared, seen) if checkpoint else None,
    )
    deformation = _deformation(recording, partitions, inputs, split, prepared, trained, config)
    _check_stop(should_stop)
    settings = {
        **config.to_json(),
        "torch": str(torch.__version__),
        "onnxruntime": onnxruntime.__version__,
        "device": str(device),
        "training_poses": len(split.training),
        "validation_poses": len(split.validation),
        "held_out_poses": len(split.held_out),
        "warm_start": warm_start,
        "sheared": deformation.sheared,
    }
    announcer.say(MessageType.LOG, text=f"Exporting the model, and measuring it on {len(split.held_out)} poses.")
    exported = build_model(recording, deformation, split.held_out, settings)
    _check_stop(should_stop)
    sample = split.training[:: max(1, len(split.training) // len(split.held_out))]
    on_training = measure(exported.session, recording, deformation, sample)
    surface = measure_surface(exported.session, recording, deformation, split.held_out)
    worst = find_worst(recording, deformation, split, exported.held_out.fdda, on_training.fdda)
    content = report.make_report(
        recording, deformation, exported, on_training, surface, trained.curves, model_path.name, worst
    )
    # Not in the model: the same recording and settings give the same bytes.
    content["training"] = {**content["training"], "seconds": round(time.perf_counter() - started, 2)}
    if recording.info.repeatability:
        content["repeatability"] = recording.info.repeatability.to_json()
    content["warnings"] = [warning.to_json() for warning in warnings]
    poses, p999 = len(recording.pose_matrices), exported.info.held_out_mm["p999"]
    history = [*(checkpoint.history if checkpoint else ()), {"poses": poses, "p999": p999}]
    goal_result = None
    if config.goal_mm:
        training_p999 = content["fdda"]["training"]["p999"]
        goal_result = evaluate_goal(config.goal_mm, history, training_p999, recording_path, model_path)
        content["goal"] = goal_result.to_json()
    page = render_html(content)
    _check_stop(should_stop)
    # From here on nothing stops: the model and what lies beside it belong together.
    with atomic_write_all(*training_outputs(model_path)) as (model, checkpoint_file, report_file, page_file):
        write_model(model, exported.content)
        write_checkpoint(checkpoint_file, deformation, held_back, config.hidden, history)
        report_file.write_text(report_text(content), encoding="utf-8")
        page_file.write_text(page, encoding="utf-8", errors="backslashreplace")
    _announce_end(announcer, model_path, content, goal_result, time.perf_counter() - started)


def _check(recording: Recording, announcer: Announcer, strict: bool) -> list[RecordingWarning]:
    """Look at the recording, and announce what is suspicious about it.

    Raises:
        RecordingError: something is, and `strict` says that it is an error.
    """
    warnings = check_recording(recording)
    for warning in warnings:
        announcer.say(MessageType.WARNING, **warning.to_json())
    if strict:
        refuse(warnings)
    return warnings


def _announce_end(
    announcer: Announcer, model_path: Path, content: dict, goal_result: GoalResult | None, seconds: float
) -> None:
    for partition in content["partitions"]:
        announcer.say(
            MessageType.PARTITION_FINISHED,
            joint=partition["joint"] or STATIC_JOINT_LABEL,
            basis=partition["basis"],
            held_out_mm=partition["held_out"]["mean"],
        )
    if goal_result:
        announcer.say(MessageType.LOG, text=goal_result.text)
    held_out = content["fdda"]["held_out"]
    announcer.say(
        MessageType.FINISHED,
        model=str(model_path),
        seconds=round(seconds, 2),
        held_out_mm=held_out["mean"],
        held_out_p999_mm=held_out["p999"],
        **({"verdict": goal_result.verdict.value} if goal_result else {}),
    )


def _initial_checkpoint(model_path: Path, recording: Recording, held_back: str, config: TrainingConfig) -> Checkpoint:
    """Read the checkpoint to start from.

    Raises:
        TrainingError: there is none, or it is of another rig, other controls, other networks or another split.
    """
    path = checkpoint_path(model_path)
    checkpoint = read_checkpoint(path)
    if checkpoint.fingerprint != recording.rig.fingerprint:
        raise TrainingError(f"The checkpoint '{path}' is of another rig; train without --warm-start.")
    if checkpoint.controls != tuple(control.name for control in recording.rig.controls):
        raise TrainingError(f"The checkpoint '{path}' is of other controls; train without --warm-start.")
    if not checkpoint.deltas.may_be_of(recording.rig):
        raise TrainingError(f"The checkpoint '{path}' is damaged; train without --warm-start.")
    if checkpoint.held_back != held_back:
        raise TrainingError(
            f"The checkpoint '{path}' is of another recording or seed, and may have been trained on poses that are "
            "held out now; train with the same, or without --warm-start."
        )
    if (checkpoint.hidden, checkpoint.activation) != (config.hidden, config.activation):
        raise TrainingError(
            f"The checkpoint '{path}' is of networks --hidden {' '.join(map(str, checkpoint.hidden))} --activation "
            f"{checkpoint.activation}; train with the same, or without --warm-start."
        )
    return checkpoint


def _shorter(config: TrainingConfig) -> TrainingConfig:
    return replace(
        config,
        epochs=max(1, round(config.epochs * WARM_EPOCHS)),
        learning_rate=config.learning_rate * WARM_RATE,
    )


def _prepare(
    recording: Recording,
    partitions: tuple[Partition, ...],
    inputs: Inputs,
    turns: bool,
    split: Split,
    config: TrainingConfig,
    announcer: Announcer,
    should_stop: Callable[[], bool],
) -> list[PreparedPartition]:
    def announce(done: int) -> None:
        announcer.say(MessageType.PREPARING, done=done, total=len(recording.partitions))
        _check_stop(should_stop)

    return prepare_together(
        partitions_of(recording, partitions, inputs, turns),
        split,
        config.tolerance_mm,
        config.seed,
        recording.rig.metres_per_unit,
        config.hidden[-1],
        announce,
    )


def _deformation(
    recording: Recording,
    partitions: tuple[Partition, ...],
    inputs: Inputs,
    split: Split,
    prepared: list[PreparedPartition],
    trained: Trained,
    config: TrainingConfig,
) -> Deformation:
    rig = recording.rig
    matrices, controls = (np.array(array[split.training]) for array in (recording.pose_matrices, recording.controls))
    features = inputs.features(matrices, rig.rest_matrices, controls)
    return Deformation(
        rig,
        partitions,
        inputs,
        tuple(prepared),
        trained.networks,
        measure_training_range(features, rig, partitions),
        config.activation,
        is_sheared(recording.pose_matrices),
    )


def _check_stop(should_stop: Callable[[], bool]) -> None:
    if should_stop():
        raise Cancelled
