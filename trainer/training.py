# SPDX-License-Identifier: GPL-3.0-or-later
"""One training, from the recording to the files that it leaves."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from fdda_addon.core.messages import MessageType
from fdda_addon.core.output import check_writable, write_json, write_text
from fdda_addon.core.recording import Recording, read_recording

from . import report
from .announcements import Announcer
from .config import TrainingConfig
from .data import PreparedPartition, Split, partitions_of, prepare, split_poses
from .deformation import Deformation
from .export import build_model, measure, write_model
from .inputs import Inputs, make_inputs, middles
from .loop import Cancelled, Trained, choose_device, train
from .page import render_html
from .trust import make_trust_range

REPORT_JSON = "report.json"
REPORT_HTML = "report.html"


def train_model(
    recording_path: Path,
    model_path: Path,
    config: TrainingConfig,
    announcer: Announcer,
    should_stop: Callable[[], bool] = lambda: False,
) -> None:
    """Train a model, and write it with its report beside it.

    Args:
        recording_path: folder of a complete recording.
        model_path: the .onnx file; it and the report are written when everything else is done.
        config: the settings.
        announcer: told everything from `STARTED` to `FINISHED`; not told of errors.
        should_stop: asked often; nothing has been written when it is heeded.

    Raises:
        Cancelled: `should_stop` said so.
        FDDAError: the recording, the settings or the output path are no good.
    """
    started = time.perf_counter()
    outputs = (model_path, model_path.with_name(REPORT_JSON), model_path.with_name(REPORT_HTML))
    for path in outputs:
        check_writable(path)
    recording = read_recording(recording_path)
    device = choose_device()
    announcer.say(
        MessageType.STARTED,
        partitions=len(recording.partitions),
        poses=len(recording.pose_matrices),
        vertices=recording.rig.vertex_count,
        device=str(device),
    )
    split = split_poses(np.arange(len(recording.pose_matrices)), config.validation_fraction, config.seed)
    inputs = make_inputs(recording.rig.parents, middles(recording.rig, recording.partitions), recording.partitions)
    prepared = _prepare(recording, inputs, split, config, should_stop)
    trained = train(
        prepared,
        split,
        config,
        device,
        lambda p: announcer.say(
            MessageType.PROGRESS,
            epoch=p.epoch,
            epochs=p.epochs,
            training_mm=round(p.training_mm, 6),
            validation_mm=round(p.validation_mm, 6),
        ),
        should_stop,
    )
    deformation = _deformation(recording, inputs, split, prepared, trained, config)
    _check_stop(should_stop)
    settings = {
        **config.to_json(),
        "torch": str(torch.__version__),
        "onnxruntime": onnxruntime.__version__,
        "device": str(device),
        "training_poses": len(split.training),
        "validation_poses": len(split.validation),
        "seconds": round(time.perf_counter() - started, 2),
    }
    exported = build_model(recording, deformation, split.validation, settings)
    _check_stop(should_stop)
    sample = split.training[:: max(1, len(split.training) // len(split.validation))]
    on_training = measure(exported.session, recording, deformation, sample)
    content = report.make_report(recording, deformation, exported, on_training, trained.curves, model_path.name)
    page = render_html(content)
    _check_stop(should_stop)
    # From here on nothing stops: the model and its report belong together.
    write_model(outputs[0], exported.content)
    write_json(outputs[1], content)
    write_text(outputs[2], page)
    for partition in content["partitions"]:
        announcer.say(
            MessageType.PARTITION_FINISHED,
            joint=partition["joint"],
            basis=partition["basis"],
            validation_mm=partition["held_out"]["mean"],
        )
    announcer.say(
        MessageType.FINISHED,
        model=str(model_path),
        seconds=round(time.perf_counter() - started, 2),
        validation_mm=exported.info.held_out_mm["mean"],
    )


def _prepare(
    recording: Recording, inputs: Inputs, split: Split, config: TrainingConfig, should_stop: Callable[[], bool]
) -> list[PreparedPartition]:
    prepared = []
    for partition in partitions_of(recording, inputs):
        _check_stop(should_stop)
        prepared.append(prepare(partition, split, config.tolerance_mm, config.seed))
    return prepared


def _deformation(
    recording: Recording,
    inputs: Inputs,
    split: Split,
    prepared: list[PreparedPartition],
    trained: Trained,
    config: TrainingConfig,
) -> Deformation:
    rig = recording.rig
    matrices = np.array(recording.pose_matrices[split.training])
    features = inputs.features(matrices, rig.rest_matrices)
    return Deformation(
        rig,
        recording.partitions,
        inputs,
        tuple(prepared),
        trained.networks,
        make_trust_range(features, rig, recording.partitions),
        config.activation,
    )


def _check_stop(should_stop: Callable[[], bool]) -> None:
    if should_stop():
        raise Cancelled
