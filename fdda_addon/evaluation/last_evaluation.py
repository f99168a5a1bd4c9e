# SPDX-License-Identifier: GPL-3.0-or-later
"""The last evaluation of each mesh object, for the sidebar, the viewport and the timeline; it lasts for the session."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import bpy

if TYPE_CHECKING:  # Blender starts without numpy.
    import numpy as np

    from ..core.metrics import ErrorStatistics
    from ..core.poses import Channel
    from .run import Evaluation

MAX_STORED = 4
"""Errors of a dense mesh take some hundred format_file_size."""
FRAMES_APART = 10
"""Worst frames that are nearer belong to one movement."""
METHODS = ("fdda", "linear")

_evaluations: dict[int, "LastEvaluation"] = {}


@dataclass(frozen=True)
class PartitionErrors:
    """Errors of the vertices of one main joint: its name, the number of vertices, statistics in mm."""

    joint: str
    vertices: int
    fdda: "ErrorStatistics"
    linear: "ErrorStatistics"


@dataclass(frozen=True)
class LastEvaluation:
    """Errors of a model on the frames of an action, or on random poses.

    Attributes:
        name: of the action; empty for random poses.
        model: name of the model's file.
        first_frame: of the action, 0 for random poses.
        seed: of the random poses.
        errors: (N, V) float32, metres, by the names of `METHODS`.
        total: statistics of all vertices by the names of `METHODS`.
        partitions: the worst first, by the largest error of the model.
        channels: that the random poses were drawn from.
    """

    name: str
    model: str
    first_frame: int
    seed: int
    errors: "dict[str, np.ndarray]"
    total: "dict[str, ErrorStatistics]"
    partitions: tuple[PartitionErrors, ...]
    channels: "tuple[Channel, ...]"

    @property
    def poses(self) -> int:
        """How many were compared."""
        return len(self.errors["fdda"])

    @property
    def vertices(self) -> int:
        """Number of vertices of the mesh."""
        return self.errors["fdda"].shape[1]

    def pose_at(self, frame: int) -> int | None:
        """Index of the pose of a frame; None where the action has none, and for random poses."""
        index = frame - self.first_frame
        return index if self.name and 0 <= index < self.poses else None

    def vertex_errors(self, way: str, statistic: str, pose: int | None = None) -> "np.ndarray | None":
        """(V,) errors in metres: the "mean" or "max" over the poses, or those of one "pose"; None without a pose."""
        errors = self.errors[way]
        if statistic == "pose":
            return None if pose is None or not 0 <= pose < len(errors) else errors[pose]
        return errors.mean(axis=0) if statistic == "mean" else errors.max(axis=0)

    def worst(self, count: int) -> list[tuple[int, float]]:
        """The poses with the largest errors of the model, the worst first: index and the largest error in mm."""
        from ..core.metrics import worst_poses

        errors = self.errors["fdda"]
        found = worst_poses(errors, count, FRAMES_APART if self.name else 1)
        return [(index, float(errors[index].max()) * 1000) for index in found]


def store(
    mesh_object: bpy.types.Object,
    evaluation: "Evaluation",
    model: str,
    action: str = "",
    first_frame: int = 0,
    seed: int = 0,
) -> LastEvaluation:
    """Sum an evaluation up and keep it.

    Args:
        mesh_object: that was evaluated.
        evaluation: the poses that count are its `held_out`.
        model: name of the model's file.
        action, first_frame: the action that was compared; empty for random poses.
        seed: of the random poses.
    """
    from ..core.metrics import error_statistics

    compared = evaluation.held_out
    errors = {way: getattr(compared, way) for way in METHODS}
    partitions = [
        PartitionErrors(
            evaluation.joints[partition.joint],
            len(partition.vertices),
            *(error_statistics(errors[way][:, partition.vertices]) for way in METHODS),
        )
        for partition in evaluation.partitions
    ]
    partitions.sort(key=lambda partition: -partition.fdda.max)
    last = LastEvaluation(
        action,
        model,
        first_frame,
        seed,
        errors,
        {way: error_statistics(errors[way]) for way in METHODS},
        tuple(partitions),
        evaluation.channels,
    )
    _evaluations.pop(mesh_object.session_uid, None)
    while len(_evaluations) >= MAX_STORED:
        del _evaluations[next(iter(_evaluations))]
    _evaluations[mesh_object.session_uid] = last
    return last


def get(mesh_object: bpy.types.Object) -> LastEvaluation | None:
    """The last evaluation of an object, None when there was none in this session."""
    return _evaluations.get(mesh_object.session_uid)


def remove(mesh_object: bpy.types.Object) -> None:
    """Drop the last evaluation of an object: its model is another now."""
    _evaluations.pop(mesh_object.session_uid, None)
