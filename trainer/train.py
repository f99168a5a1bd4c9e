# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a training: all steps from the recording to the written files."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from fdda_addon.core.checks.recording import check_recording, merges_sentence
from fdda_addon.core.checks.warning import RecordingWarning, raise_first_warning
from fdda_addon.core.files.output import atomic_write_all
from fdda_addon.core.formats.messages import PARTITIONS_STAGE, MessageType
from fdda_addon.core.formats.report import report_text
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.recording.estimate import format_size, recording_bytes
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import STATIC_JOINT_LABEL
from fdda_addon.core.settings import automatic_passes

from .compression import drop_components, dropped_components_sentence, factorize_partition
from .config import TrainingConfig
from .data.split import Split, holdout_fingerprint, split_recording
from .device import CPU, WARNING_NAME, choose_device, error_summary, unusable_card_text
from .export.export import ExportedModel, build_model, measure, measure_surface, write_model
from .fits.half_rotations import half_rotations_help
from .goal import evaluate_goal
from .inputs.network_inputs import NetworkInputs, fit_inputs, make_inputs
from .inputs.surface_frames import SurfaceFrameFeatures
from .model import TrainedModel, make_trained_model
from .networks.checkpoint import Checkpoint, write_checkpoint
from .networks.loop import train
from .networks.networks import TrainedPartition
from .networks.warm_start import checkpoint_parts, initial_networks, read_initial_checkpoint, warm_start_config
from .outputs import training_outputs
from .preparation import PartitionData, choose_details, make_parts, partition_data, prepare_partitions
from .progress import MessageSink
from .report.contents import make_report
from .report.error_analysis import analyze_errors
from .report.page import render_html
from .skin.split_deformation import split_deformation


def train_model(
    recording_path: Path,
    model_path: Path,
    config: TrainingConfig,
    sink: MessageSink,
    stoppable: Callable[[], AbstractContextManager] = nullcontext,
    warm_start: bool = False,
    strict: bool = False,
) -> None:
    """Train a model, and write it with its checkpoint and its report beside it.

    Args:
        recording_path: folder of a complete recording.
        model_path: the .onnx file; `check_training_outputs` has checked it. All files are written at the end.
        sink: receives the messages from `STARTED` to `FINISHED`. Errors are raised, not sent.
        stoppable: makes the context in which the process may be ended, because it writes nothing there.
        warm_start: start from the checkpoint of the model, on a recording that may have grown since.
        strict: treat warnings about the recording as errors.

    Raises:
        FDDAError: the recording or the settings cannot be used, or a file cannot be written.
    """
    start_time = time.perf_counter()
    with stoppable():
        recording = split_deformation(read_recording(recording_path), config, sink)
        split = split_recording(recording, config)
        config = replace(config, passes=config.passes or automatic_passes(len(recording.pose_matrices)))
        meshes = recording.rig.meshes
        details_mm = np.full(len(meshes), config.detail_mm) if config.detail_mm else choose_details(recording, split)
        holdout = holdout_fingerprint(recording, split)
        checkpoint = read_initial_checkpoint(model_path, recording, holdout, config) if warm_start else None
        job = _Job(config, details_mm, sink, recording, split, checkpoint)
        warnings = job.start(strict)
        parts = job.make_parts()
        inputs = job.fit_inputs(parts)
        partitions = job.collect_partition_data(inputs, parts)
        prepared = job.compress(job.train_networks(partitions), partitions)
        trained_model = make_trained_model(recording, inputs, split, parts, prepared)
        exported = job.export(trained_model)
        report = job.measure(trained_model, exported, model_path.name)
        entry = {"poses": len(recording.pose_matrices), "p999": exported.info.held_out_mm["p999"]}
        history = [*(checkpoint.history if checkpoint else ()), entry]
        goal_text = ""
        if config.goal_mm:
            training_p999_mm = report["fdda"]["training"]["p999"]
            verdict, goal_text = evaluate_goal(config.goal_mm, history, training_p999_mm, recording_path, model_path)
            report["goal"] = {"goal": config.goal_mm, "p999": entry["p999"], "verdict": verdict.value}
        # The time is in the report only, so that equal recordings and settings give equal models.
        report["training"] = {**report["training"], "seconds": round(time.perf_counter() - start_time, 2)}
        report["warnings"] = [warning.to_json() for warning in warnings]
        page = render_html(report)
    model_path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write_all(*training_outputs(model_path)) as (model, checkpoint_file, report_file, page_file):
        write_model(model, exported.content)
        write_checkpoint(checkpoint_file, trained_model.checkpoint(recording.digest(), holdout, config, history))
        report_file.write_text(report_text(report), encoding="utf-8")
        page_file.write_text(page, encoding="utf-8", errors="backslashreplace")
    _send_final_messages(sink, model_path, report, goal_text, start_time)


@dataclass
class _Job:
    """The steps of a training that send messages.

    Attributes:
        details_mm: detail of each mesh, mm.
        checkpoint: that of a warm start.
    """

    config: TrainingConfig
    details_mm: np.ndarray
    sink: MessageSink
    recording: SkinnedRecording
    split: Split
    checkpoint: Checkpoint | None
    device: str = CPU

    def log(self, text: str) -> None:
        self.sink.send(MessageType.LOG, text=text)

    def warn_of_card(self, card: str, problem: str) -> None:
        self.sink.send(MessageType.WARNING, name=WARNING_NAME, text=unusable_card_text(card, problem))

    def start(self, strict: bool) -> list[RecordingWarning]:
        """Send what is trained on which device, check the recording, and return its warnings.

        Raises:
            RecordingError: there are warnings, and `strict` is set.
        """
        chosen = choose_device()
        self.device = chosen.device
        self.sink.send(
            MessageType.STARTED,
            partitions=len(self.recording.partitions),
            poses=len(self.recording.pose_matrices),
            vertices=self.recording.rig.vertex_count,
            device=self.device,
        )
        if chosen.problem:
            self.warn_of_card(chosen.card, chosen.problem)
        self.log(_training_size_sentence(self.recording))
        if merges := merges_sentence(self.recording, self.config.min_vertices_per_part):
            self.log(merges)
        warnings = check_recording(self.recording)
        for warning in warnings:
            self.sink.send(MessageType.WARNING, **warning.to_json())
        if strict:
            raise_first_warning(warnings)
        names = [f"'{mesh.name}' " if len(self.details_mm) > 1 else "" for mesh in self.recording.rig.meshes]
        details = [f"{name}{detail:.2g} mm" for name, detail in zip(names, self.details_mm, strict=True)]
        self.log(f"{self.config.passes} passes. Detail: {', '.join(details)}.")
        return warnings

    def make_parts(self) -> list[Partition]:
        """Divide partitions into parts. A warm start keeps the parts of the checkpoint."""
        if self.checkpoint:
            return checkpoint_parts(self.checkpoint, self.recording)
        return make_parts(self.recording, self.split, self._tolerances, self.config.min_vertices_per_part)

    @property
    def _tolerances(self) -> np.ndarray:
        """(M,) float64, the detail of each mesh, mesh units."""
        return self.details_mm / (1000 * self.recording.rig.metres_per_unit)

    def fit_inputs(self, parts: list[Partition]) -> NetworkInputs:
        """Fit the inputs of the networks. A warm start keeps the inputs of the checkpoint."""
        if self.checkpoint:
            states = self.checkpoint.input_states
        else:
            states = fit_inputs(self.recording, self.split, replace(self.config, detail_mm=self.details_mm.min()))
        inputs = make_inputs(self.recording.rig, parts, states)
        for block in inputs.blocks:
            if block.log_text:
                self.log(block.log_text)
        return inputs

    def collect_partition_data(self, inputs: NetworkInputs, parts: list[Partition]) -> list[PartitionData]:
        """Collect the data of all parts, and decide whether half-rotation features help."""
        # Surface frames make half-rotation features unnecessary.
        use_half_rotations = not inputs.states.get(SurfaceFrameFeatures.name) and half_rotations_help(
            self.recording, self.split.training
        )
        if use_half_rotations:
            self.log("The rig blends rotations: residuals are fitted to half-rotation features, too.")
        return partition_data(self.recording, inputs, use_half_rotations, parts)

    def train_networks(self, partitions: list[PartitionData]) -> list[TrainedPartition]:
        """Prepare the partitions, and train their networks from random weights, or from a checkpoint."""
        config, initial = self.config, None
        prepared = prepare_partitions(
            partitions,
            self.split,
            self.details_mm,
            config,
            self.recording.rig.metres_per_unit,
            lambda done: self.sink.send(
                MessageType.PREPARING, stage=PARTITIONS_STAGE, done=done, total=len(partitions)
            ),
        )
        if self.checkpoint:
            config, initial = warm_start_config(config), initial_networks(self.checkpoint, prepared)

        def send_progress(epoch: int, training_mm: float, validation_mm: float) -> None:
            errors = {"training_mm": round(training_mm, 6), "validation_mm": round(validation_mm, 6)}
            self.sink.send(MessageType.PROGRESS, epoch=epoch, epochs=config.passes, **errors)

        try:
            return train(prepared, self.split, config, self.device, send_progress, initial)
        except RuntimeError as error:
            if self.device == CPU:
                raise
            # Another program may take the memory of the card meanwhile.
            self.warn_of_card(choose_device().card, error_summary(error))
        self.device = CPU
        return train(prepared, self.split, config, self.device, send_progress, initial)

    def compress(self, prepared: list[TrainedPartition], partitions: list[PartitionData]) -> list[TrainedPartition]:
        """Drop components that the networks do not predict, and factorize large partitions."""
        remaining = drop_components(prepared, self.split)
        if text := dropped_components_sentence(prepared, remaining):
            self.log(text)
        return [
            factorize_partition(*pair, self.split, self._tolerances[pair[0].mesh])
            for pair in zip(remaining, partitions, strict=True)
        ]

    def export(self, trained_model: TrainedModel) -> ExportedModel:
        """Build the model, and compare it with PyTorch on the held-out poses."""
        details = [round(detail, 6) for detail in self.details_mm.tolist()]
        training_info = {
            **self.config.to_json(),
            "detail_mm": details if len(details) > 1 else details[0],
            "torch": str(torch.__version__),
            "onnxruntime": onnxruntime.__version__,
            "device": self.device,
            "training_poses": len(self.split.training),
            "validation_poses": len(self.split.validation),
            "held_out_poses": len(self.split.held_out),
            "warm_start": self.checkpoint is not None,
        }
        self.log(f"Exporting the model, and measuring it on {len(self.split.held_out)} poses.")
        return build_model(self.recording, trained_model, self.split.held_out, training_info)

    def measure(self, trained_model: TrainedModel, exported: ExportedModel, model_name: str) -> dict:
        """Measure the model on training and held-out poses; returns the content of the report."""
        recording, split = self.recording, self.split
        training_sample = split.training[:: max(1, len(split.training) // len(split.held_out))]
        training_errors = measure(exported.session, recording, training_sample)
        surface = measure_surface(exported.session, recording, split.held_out)
        analyses = analyze_errors(recording, trained_model, split, exported.held_out.fdda, training_errors.fdda)
        return make_report(recording, trained_model, exported, training_errors, surface, model_name, analyses)


def _training_size_sentence(recording: SkinnedRecording) -> str:
    """Describe the disk space of a recording and the memory that its training needs."""
    poses, rig = len(recording.rows), recording.rig
    disk_space = format_size(recording_bytes(rig, len(recording.recorded_positions)))
    largest = max(recording.partitions, key=lambda partition: len(partition.vertices))
    vertices = len(largest.vertices)
    return (
        f"{poses:,} poses of {rig.vertex_count:,} vertices: {disk_space} on the disk; residuals "
        f"of the largest partition, '{rig.joints[largest.joint].name or STATIC_JOINT_LABEL}', of "
        f"{vertices:,} vertices: {format_size(12 * poses * vertices)}, in memory two or three times."
    )


def _send_final_messages(sink: MessageSink, model_path: Path, report: dict, goal_text: str, start_time: float) -> None:
    """Send the messages after the files are written; arguments as in `train_model`."""
    for partition in report["partitions"]:
        sink.send(
            MessageType.PARTITION_FINISHED,
            joint=partition["joint"] or STATIC_JOINT_LABEL,
            basis=partition["basis"],
            held_out_mm=partition["held_out"]["mean"],
        )
    for mesh in report["meshes"] if len(report["meshes"]) > 1 else ():
        mean, linear = mesh["held_out"]["mean"], mesh["linear"]["mean"]
        ratio = f", {100 * mean / linear:.1f} % of linear skinning's" if linear else ""
        sink.send(MessageType.LOG, text=f"'{mesh['name']}': held-out error {mean:.4f} mm{ratio}")
    if goal_text:
        sink.send(MessageType.LOG, text=goal_text)
    values = {
        "model": str(model_path),
        "seconds": round(time.perf_counter() - start_time, 2),
        "held_out_mm": report["fdda"]["held_out"]["mean"],
        "held_out_p999_mm": report["fdda"]["held_out"]["p999"],
        **({"verdict": report["goal"]["verdict"]} if "goal" in report else {}),
    }
    sink.send(MessageType.FINISHED, **values)
