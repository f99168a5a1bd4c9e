# SPDX-License-Identifier: GPL-3.0-or-later
"""The content of `report.json`."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from fdda_addon.core.mathematics.metrics import error_statistics
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.rig import Rig

from ..export.export import ExportedModel, Measurement
from ..model import TrainedModel
from ..networks.networks import TrainedPartition
from .error_analysis import ErrorAnalysis

HISTOGRAM_EDGES_MM = np.concatenate([[0.0], np.geomspace(1e-4, 1e3, 71)])
"""Bin edges of the histogram, mm: ten bins per decade; the first bin holds all errors below 0.0001 mm."""


def make_report(
    recording: Recording,
    trained_model: TrainedModel,
    exported: ExportedModel,
    training_errors: Measurement,
    surface: dict,
    model_name: str,
    analyses: Sequence[ErrorAnalysis],
) -> dict:
    """Create the content of `report.json`; docs/formats.md describes the keys. Errors are in mm.

    Args:
        recording, trained_model, exported: input and results of the training.
        training_errors: errors on a sample of the training poses.
        surface: `normals` and `edges` of held-out poses.
        model_name: file name of the model.
        analyses: analysis of the largest errors of each partition.
    """
    controls, held_out = [control.name for control in recording.rig.controls], exported.held_out
    partitions = [
        _partition_entry(recording.rig, partition, prepared, analysis, held_out, training_errors)
        for partition, prepared, analysis in zip(
            trained_model.partitions, trained_model.prepared, analyses, strict=True
        )
    ]
    return {
        "unit": "mm",
        "model": model_name,
        "model_bytes": len(exported.content),
        "recording": recording.path.name,
        "object": recording.info.object_name,
        "vertices": recording.rig.vertex_count,
        "joints": len(recording.rig.joints),
        **({"controls": controls} if controls else {}),
        "poses": len(recording.pose_matrices),
        "training": exported.info.training,
        "parity": exported.info.parity_mm,
        "constant_bytes": exported.info.constant_bytes,
        "fdda": {"training": error_statistics(training_errors.fdda).to_json(), "held_out": exported.info.held_out_mm},
        "linear": {"held_out": error_statistics(held_out.linear).to_json()},
        **surface,
        "histogram": {
            "edges": HISTOGRAM_EDGES_MM.tolist(),
            "fdda": _histogram(held_out.fdda),
            "linear": _histogram(held_out.linear),
        },
        "partitions": partitions,
        **({"repeatability": recording.info.repeatability.to_json()} if recording.info.repeatability else {}),
    }


def _partition_entry(
    rig: Rig,
    partition: Partition,
    prepared: TrainedPartition,
    analysis: ErrorAnalysis,
    held_out: Measurement,
    training_errors: Measurement,
) -> dict:
    names, controls, vertices = rig.joint_names, [control.name for control in rig.controls], partition.vertices
    curves = prepared.curves
    return {
        "joint": names[partition.joint],
        "vertices": len(vertices),
        "influencing": [names[joint] for joint in partition.influencing],
        **({"controls": [controls[control] for control in partition.controls]} if partition.controls else {}),
        **({"merged": [names[joint] for joint in partition.merged]} if partition.merged else {}),
        "features": len(prepared.columns),
        "basis": len(prepared.basis.components),
        "dropped": prepared.dropped_count,
        "truncation": prepared.basis.truncation_rms * prepared.mm_per_unit,
        "training": error_statistics(training_errors.fdda[:, vertices]).to_json(),
        "held_out": error_statistics(held_out.fdda[:, vertices]).to_json(),
        "linear": error_statistics(held_out.linear[:, vertices]).to_json(),
        "histogram": _histogram(held_out.fdda[:, vertices]),
        "largest_errors": asdict(analysis),
        "curve": {
            "training": [round(value, 6) for value in curves.training_mm],
            "validation": [round(value, 6) for value in curves.validation_mm],
            "worst": [round(value, 6) for value in curves.worst_mm],
            "best_epoch": curves.best_epoch,
        },
    }


def _histogram(errors: np.ndarray) -> list[int]:
    return np.histogram(np.minimum(errors * 1000, HISTOGRAM_EDGES_MM[-1]), HISTOGRAM_EDGES_MM)[0].tolist()
