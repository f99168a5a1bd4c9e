# SPDX-License-Identifier: GPL-3.0-or-later
"""The content of `report.json`."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from fdda_addon.core.mathematics.metrics import error_statistics
from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.recording.skinned import SkinnedRecording

from ..export.export import ExportedModel, Measurement
from ..model import TrainedModel
from ..networks.networks import Curves, TrainedPartition
from .error_analysis import ErrorAnalysis

HISTOGRAM_EDGES_MM = np.concatenate([[0.0], np.geomspace(1e-4, 1e3, 71)])
"""Bin edges of the histogram, mm: ten bins per decade; the first bin holds all errors below 0.0001 mm."""


def make_report(
    recording: SkinnedRecording,
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
        _partition_entry(trained_model, partition, analysis, held_out, training_errors)
        for partition, analysis in zip(trained_model.partitions, analyses, strict=True)
    ]
    return {
        "unit": "mm",
        "model": model_name,
        "model_bytes": len(exported.content),
        "recording": recording.path.name,
        "meshes": [
            {
                "name": mesh.name,
                "vertices": mesh.vertices,
                "held_out": error_statistics(held_out.fdda[:, vertices]).to_json(),
                "linear": error_statistics(held_out.linear[:, vertices]).to_json(),
            }
            for mesh, vertices in zip(recording.rig.meshes, recording.rig.mesh_slices, strict=True)
        ],
        "vertices": recording.rig.vertex_count,
        "joints": len(recording.rig.joints),
        **({"controls": controls} if controls else {}),
        "poses": len(recording.pose_matrices),
        "training": exported.info.training,
        "parity": exported.info.parity_mm,
        "fdda": {"training": error_statistics(training_errors.fdda).to_json(), "held_out": exported.info.held_out_mm},
        "linear": {"held_out": error_statistics(held_out.linear).to_json()},
        **surface,
        "histogram": {
            "edges": HISTOGRAM_EDGES_MM.tolist(),
            "fdda": _histogram(held_out.fdda),
            "linear": _histogram(held_out.linear),
        },
        "partitions": partitions,
        **({"repeatability_mm": mm} if (mm := recording.info.repeatability_mm) is not None else {}),
    }


def _partition_entry(
    trained_model: TrainedModel,
    partition: Partition,
    analysis: ErrorAnalysis,
    held_out: Measurement,
    training_errors: Measurement,
) -> dict:
    rig, vertices = trained_model.rig, partition.vertices
    names, controls = rig.joint_names, [control.name for control in rig.controls]
    parts = [prepared for _, prepared in trained_model.parts_of(partition)]
    keys = sorted({int(key) for part in parts for key in part.fit.controls})
    sizes, curves = [part.vertex_count for part in parts], _common_curves(parts)
    return {
        "joint": names[partition.joint],
        "vertices": len(vertices),
        "influencing": [names[joint] for joint in partition.influencing],
        **({"controls": [controls[control] for control in partition.controls]} if partition.controls else {}),
        **({"merged": [names[joint] for joint in partition.merged]} if partition.merged else {}),
        **({"linear_keys": [controls[key] for key in keys]} if keys else {}),
        **({"parts": len(parts)} if len(parts) > 1 else {}),
        "features": len(np.unique(np.concatenate([part.columns for part in parts]))),
        "basis": sum(len(part.basis.components) for part in parts),
        "dropped": sum(part.dropped_count for part in parts),
        "truncation": float(
            np.sqrt(np.average([(p.basis.truncation_rms * p.mm_per_unit) ** 2 for p in parts], weights=sizes))
        ),
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


def _common_curves(parts: Sequence[TrainedPartition]) -> Curves:
    """Combine the curves of the parts of a partition; parts without a network have no curve."""
    if len(parts) == 1:
        return parts[0].curves
    learned = [part for part in parts if part.curves.validation_mm]
    if not learned:
        return Curves()
    weights = np.array([part.vertex_count for part in learned])
    squares = [
        np.average([np.square(getattr(part.curves, name)) for part in learned], axis=0, weights=weights)
        for name in ("training_mm", "validation_mm", "worst_mm")
    ]
    return Curves(*(np.sqrt(values).tolist() for values in squares))


def _histogram(errors: np.ndarray) -> list[int]:
    return np.histogram(np.minimum(errors * 1000, HISTOGRAM_EDGES_MM[-1]), HISTOGRAM_EDGES_MM)[0].tolist()
