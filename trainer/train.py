# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a training: all steps from the recording to the written files."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from fdda_addon.core.checks.recording import check_recording
from fdda_addon.core.checks.warning import RecordingWarning, raise_first_warning
from fdda_addon.core.messages import MessageType
from fdda_addon.core.output import atomic_write_all
from fdda_addon.core.partition import Partition
from fdda_addon.core.recording.estimate import training_size_sentence
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.core.report import report_text
from fdda_addon.core.rig import STATIC_JOINT_LABEL

from .config import TrainingConfig
from .data.split import Split, holdout_fingerprint, split_recording
from .export.export import build_model, measure, measure_surface, write_model
from .fits.gravity import drop_gravity_input
from .fits.half_rotations import half_rotations_help
from .goal import GoalResult, evaluate_goal
from .inputs.network_inputs import NetworkInputs, fit_inputs, make_inputs
from .inputs.surface_frames import SurfaceFrameFeatures
from .model import TrainedModel, is_sheared
from .networks.checkpoint import write_checkpoint
from .networks.confidence import measure_training_range
from .networks.loop import TrainingResult, choose_device, train
from .networks.warm_start import initial_networks, read_initial_checkpoint, warm_start_config
from .outputs import check_training_outputs, training_outputs
from .preparation import PreparedPartition, partition_data, prepare_partitions
from .process import Cancelled
from .progress import MessageSink
from .report.contents import make_report
from .report.error_analysis import analyze_errors
from .report.page import render_html


def train_model(
    recording_path: Path,
    model_path: Path,
    config: TrainingConfig,
    sink: MessageSink,
    should_stop: Callable[[], bool] = lambda: False,
    warm_start: bool = False,
    strict: bool = False,
    overwrite: bool = False,
) -> None:
    """Train a model, and write it with its checkpoint and its report beside it.

    Args:
        recording_path: folder of a complete recording.
        model_path: the .onnx file. All files are written at the end.
        config: settings of the training.
        sink: receives the messages from `STARTED` to `FINISHED`. Errors are raised, not sent.
        should_stop: called often. If it returns True, the training stops and writes nothing.
        warm_start: start from the checkpoint of the model, on a recording that may have grown since.
        strict: treat warnings about the recording as errors.
        overwrite: overwrite files of another kind.

    Raises:
        Cancelled: `should_stop` returned True.
        FDDAError: the recording, the settings or the output path cannot be used.
    """
    start_time = time.perf_counter()
    check_training_outputs(model_path, overwrite)
    recording = read_recording(recording_path)
    split = split_recording(recording, config)
    holdout = holdout_fingerprint(recording, split)
    checkpoint = read_initial_checkpoint(model_path, recording, holdout, config) if warm_start else None
    device = choose_device()
    sink.send(
        MessageType.STARTED,
        partitions=len(recording.partitions),
        poses=len(recording.pose_matrices),
        vertices=recording.rig.vertex_count,
        device=str(device),
    )
    sink.send(MessageType.LOG, text=training_size_sentence(recording))
    warnings = _check_recording(recording, sink, strict)
    _raise_if_stopped(should_stop)
    recording = drop_gravity_input(recording, split)
    # A warm start keeps the inputs of the checkpoint.
    input_states = checkpoint.input_states if checkpoint else fit_inputs(recording, split, config, should_stop)
    for block in make_inputs(recording.rig, recording.partitions, input_states).blocks:
        if block.log_text:
            sink.send(MessageType.LOG, text=block.log_text)
    # Surface frames make half-rotation features unnecessary.
    has_surface_frames = bool(input_states.get(SurfaceFrameFeatures.name))
    use_half_rotations = not has_surface_frames and half_rotations_help(recording, split.training, should_stop)
    if use_half_rotations:
        sink.send(
            MessageType.LOG, text="The rig blends rotations: residuals are fitted to half-rotation features, too."
        )
    partitions = recording.partitions
    inputs = make_inputs(recording.rig, partitions, input_states)
    prepared = _prepare_partitions(recording, partitions, inputs, use_half_rotations, split, config, sink, should_stop)
    columns = [
        offered_columns[partition.columns] for offered_columns, partition in zip(inputs.columns, prepared, strict=True)
    ]
    result = train(
        prepared,
        split,
        warm_start_config(config) if checkpoint else config,
        device,
        lambda progress: sink.send(
            MessageType.PROGRESS,
            epoch=progress.epoch,
            epochs=progress.epochs,
            training_mm=round(progress.training_mm, 6),
            validation_mm=round(progress.validation_mm, 6),
        ),
        should_stop,
        initial_networks(checkpoint, prepared, columns) if checkpoint else None,
    )
    trained_model = _make_trained_model(recording, partitions, inputs, split, prepared, result, config)
    _raise_if_stopped(should_stop)
    training_info = {
        **config.to_json(),
        "torch": str(torch.__version__),
        "onnxruntime": onnxruntime.__version__,
        "device": str(device),
        "training_poses": len(split.training),
        "validation_poses": len(split.validation),
        "held_out_poses": len(split.held_out),
        "warm_start": warm_start,
        "sheared": trained_model.sheared,
    }
    sink.send(MessageType.LOG, text=f"Exporting the model, and measuring it on {len(split.held_out)} poses.")
    exported = build_model(recording, trained_model, split.held_out, training_info)
    _raise_if_stopped(should_stop)
    training_sample = split.training[:: max(1, len(split.training) // len(split.held_out))]
    training_errors = measure(exported.session, recording, trained_model, training_sample)
    surface = measure_surface(exported.session, recording, trained_model, split.held_out)
    analyses = analyze_errors(recording, trained_model, split, exported.held_out.fdda, training_errors.fdda)
    report = make_report(
        recording, trained_model, exported, training_errors, surface, result.curves, model_path.name, analyses
    )
    # The time is in the report only, so that equal recordings and settings give equal models.
    report["training"] = {**report["training"], "seconds": round(time.perf_counter() - start_time, 2)}
    if recording.info.repeatability:
        report["repeatability"] = recording.info.repeatability.to_json()
    report["warnings"] = [warning.to_json() for warning in warnings]
    pose_count, p999_mm = len(recording.pose_matrices), exported.info.held_out_mm["p999"]
    history = [*(checkpoint.history if checkpoint else ()), {"poses": pose_count, "p999": p999_mm}]
    goal_result = None
    if config.goal_mm:
        training_p999_mm = report["fdda"]["training"]["p999"]
        goal_result = evaluate_goal(config.goal_mm, history, training_p999_mm, recording_path, model_path)
        report["goal"] = goal_result.to_json()
    page = render_html(report)
    _raise_if_stopped(should_stop)
    # The training cannot be stopped while it writes, because model, checkpoint and report belong together.
    with atomic_write_all(*training_outputs(model_path)) as (model, checkpoint_file, report_file, page_file):
        write_model(model, exported.content)
        write_checkpoint(checkpoint_file, trained_model.checkpoint(holdout, config.hidden, history))
        report_file.write_text(report_text(report), encoding="utf-8")
        page_file.write_text(page, encoding="utf-8", errors="backslashreplace")
    _send_final_messages(sink, model_path, report, goal_result, time.perf_counter() - start_time)


def _check_recording(recording: Recording, sink: MessageSink, strict: bool) -> list[RecordingWarning]:
    """Check the recording, send its warnings, and return them.

    Raises:
        RecordingError: there are warnings, and `strict` is set.
    """
    warnings = check_recording(recording)
    for warning in warnings:
        sink.send(MessageType.WARNING, **warning.to_json())
    if strict:
        raise_first_warning(warnings)
    return warnings


def _send_final_messages(
    sink: MessageSink, model_path: Path, report: dict, goal_result: GoalResult | None, seconds: float
) -> None:
    for partition in report["partitions"]:
        sink.send(
            MessageType.PARTITION_FINISHED,
            joint=partition["joint"] or STATIC_JOINT_LABEL,
            basis=partition["basis"],
            held_out_mm=partition["held_out"]["mean"],
        )
    if goal_result:
        sink.send(MessageType.LOG, text=goal_result.text)
    held_out = report["fdda"]["held_out"]
    sink.send(
        MessageType.FINISHED,
        model=str(model_path),
        seconds=round(seconds, 2),
        held_out_mm=held_out["mean"],
        held_out_p999_mm=held_out["p999"],
        **({"verdict": goal_result.verdict.value} if goal_result else {}),
    )


def _prepare_partitions(
    recording: Recording,
    partitions: tuple[Partition, ...],
    inputs: NetworkInputs,
    use_half_rotations: bool,
    split: Split,
    config: TrainingConfig,
    sink: MessageSink,
    should_stop: Callable[[], bool],
) -> list[PreparedPartition]:
    def send_progress(prepared_count: int) -> None:
        sink.send(MessageType.PREPARING, done=prepared_count, total=len(recording.partitions))
        _raise_if_stopped(should_stop)

    return prepare_partitions(
        partition_data(recording, partitions, inputs, use_half_rotations),
        split,
        config.tolerance_mm,
        config.seed,
        recording.rig.metres_per_unit,
        config.hidden[-1],
        send_progress,
    )


def _make_trained_model(
    recording: Recording,
    partitions: tuple[Partition, ...],
    inputs: NetworkInputs,
    split: Split,
    prepared: list[PreparedPartition],
    result: TrainingResult,
    config: TrainingConfig,
) -> TrainedModel:
    rig = recording.rig
    matrices, controls = (np.array(array[split.training]) for array in (recording.pose_matrices, recording.controls))
    features = inputs.compute_features(matrices, controls)
    return TrainedModel(
        rig,
        partitions,
        inputs,
        tuple(prepared),
        result.networks,
        measure_training_range(features, rig, partitions),
        config.activation,
        is_sheared(recording.pose_matrices),
    )


def _raise_if_stopped(should_stop: Callable[[], bool]) -> None:
    if should_stop():
        raise Cancelled
