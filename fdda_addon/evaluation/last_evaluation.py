# SPDX-License-Identifier: GPL-3.0-or-later
"""Stores the last evaluation of each mesh object until Blender ends, for the sidebar, the viewport and the timeline."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import bpy
import numpy as np

from ..core.mathematics.metrics import ErrorStatistics, error_statistics, worst_poses
from ..core.mathematics.poses import Channel
from ..scene.time_stretching import time_ratio, time_to_frame
from .results import Evaluation

MAX_STORED_EVALUATIONS = 4
"""Largest number of stored evaluations, because the errors of a dense mesh take much memory."""
MIN_FRAMES_APART = 10
"""Smallest number of frames between two worst frames, because closer frames belong to the same movement."""
METHODS = ("fdda", "linear")
"""The methods whose errors are evaluated: the model, and linear skinning alone."""

_evaluations: dict[int, "LastEvaluation"] = {}
"""The stored evaluations, by the session ids of mesh objects, oldest first."""


@dataclass(frozen=True)
class PartitionErrors:
    """Errors of one partition.

    Attributes:
        joint: name of the main joint of the partition.
        vertices: number of vertices.
        fdda: statistics of the errors of the model, mm.
        linear: statistics of the errors of linear skinning, mm.
    """

    joint: str
    vertices: int
    fdda: "ErrorStatistics"
    linear: "ErrorStatistics"


@dataclass
class LastEvaluation:
    """Errors of a model on the frames of an action, or on random poses.

    Only the attributes of a closed file change.

    Attributes:
        name: name of the action; empty for random poses.
        model: file name of the model.
        first_frame: first frame of the action; 0 for random poses.
        seed: seed of the random poses.
        errors: (N, V) float32, meters, for each of `METHODS`.
        total: statistics of the errors of all vertices, mm, for each of `METHODS`.
        partitions: errors of the partitions, in descending order of the largest error of the model.
        channels: channels of the random poses.
        closed_character: identifies the character after its file was closed (`reopening`); empty before.
        was_painted: whether the heat map showed the errors when the file was closed.
    """

    name: str
    model: str
    first_frame: int
    seed: int
    errors: "dict[str, np.ndarray]"
    total: "dict[str, ErrorStatistics]"
    partitions: tuple[PartitionErrors, ...]
    channels: "tuple[Channel, ...]"
    closed_character: tuple = ()
    was_painted: bool = False
    _cached: dict[tuple, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def poses(self) -> int:
        """Return the number of poses."""
        return len(self.errors["fdda"])

    @property
    def vertices(self) -> int:
        """Return the number of vertices of the mesh."""
        return self.errors["fdda"].shape[1]

    def pose_at(self, frame: int) -> int | None:
        """Return the index of the pose at a frame of the scene; None outside the action, or for random poses."""
        index = round(frame * time_ratio()) - self.first_frame
        return index if self.name and 0 <= index < self.poses else None

    def scene_frame(self, index: int) -> float:
        """Return the frame of the scene that shows a pose of the action, with a fraction."""
        return time_to_frame(self.first_frame + index)

    def vertex_errors(self, method: str, statistic: str, pose: int | None = None) -> "np.ndarray | None":
        """Compute the errors of all vertices.

        Args:
            method: one of `METHODS`.
            statistic: "mean" or "max" over all poses, or "pose" for the errors in one pose.
            pose: index of this pose.

        Returns:
            (V,) float32, meters; None if there is no such pose.
        """
        errors = self.errors[method]
        if statistic == "pose":
            return None if pose is None or not 0 <= pose < len(errors) else errors[pose]
        return self._computed_once(
            (method, statistic), lambda: errors.mean(axis=0) if statistic == "mean" else errors.max(axis=0)
        )

    def errors_by_frame(self) -> list[tuple[int, float]]:
        """Return pairs of frame of the action and largest error of the model in mm; empty for random poses."""
        if not self.name:
            return []
        return self._computed_once(
            ("errors_by_frame",),
            lambda: list(enumerate((self.errors["fdda"].max(axis=1) * 1000).tolist(), self.first_frame)),
        )

    def worst_poses(self, count: int) -> list[tuple[int, float]]:
        """Return the poses with the largest errors of the model, worst first, as pairs of index and error in mm."""
        return self._computed_once(("worst_poses", count), lambda: self._find_worst_poses(count))

    def _find_worst_poses(self, count: int) -> list[tuple[int, float]]:
        errors = self.errors["fdda"]
        indices = worst_poses(errors, count, MIN_FRAMES_APART if self.name else 1)
        return [(index, float(errors[index].max()) * 1000) for index in indices]

    def _computed_once(self, key: tuple, compute: Callable[[], Any]) -> Any:
        """Return the stored result of a computation: each redraw needs it, and there are millions of errors."""
        if key not in self._cached:
            self._cached[key] = compute()
        return self._cached[key]


def store(
    mesh_object: bpy.types.Object,
    evaluation: "Evaluation",
    model: str,
    action: str = "",
    first_frame: int = 0,
    seed: int = 0,
) -> LastEvaluation:
    """Summarize and store an evaluation.

    Args:
        mesh_object: the mesh object of the evaluation.
        evaluation: the evaluation; the errors on its `held_out` poses are stored.
        model: file name of the model.
        action: name of the action that was compared; empty for random poses.
        first_frame: first frame of the action; 0 for random poses.
        seed: seed of the random poses.
    """
    errors = {method: getattr(evaluation.held_out, method) for method in METHODS}
    partitions = [
        PartitionErrors(
            evaluation.joints[partition.joint],
            len(partition.vertices),
            *(error_statistics(errors[method][:, partition.vertices]) for method in METHODS),
        )
        for partition in evaluation.partitions
    ]
    partitions.sort(key=lambda partition: -partition.fdda.max)
    stored_evaluation = LastEvaluation(
        action,
        model,
        first_frame,
        seed,
        errors,
        {method: error_statistics(errors[method]) for method in METHODS},
        tuple(partitions),
        evaluation.channels,
    )
    restore(mesh_object, stored_evaluation)
    return stored_evaluation


def restore(mesh_object: bpy.types.Object, evaluation: LastEvaluation) -> None:
    """Store an evaluation as the last of an object."""
    for uid in [uid for uid, stored in _evaluations.items() if stored is evaluation]:
        del _evaluations[uid]
    _evaluations.pop(mesh_object.session_uid, None)
    while len(_evaluations) >= MAX_STORED_EVALUATIONS:
        del _evaluations[next(iter(_evaluations))]
    _evaluations[mesh_object.session_uid] = evaluation


def get(mesh_object: bpy.types.Object) -> LastEvaluation | None:
    """Return the last evaluation of an object; None if it was not evaluated in this session."""
    return _evaluations.get(mesh_object.session_uid)


def closed(character: tuple) -> LastEvaluation | None:
    """Return the newest evaluation of a character of a closed file; None if none is stored."""
    return next((e for e in reversed(_evaluations.values()) if e.closed_character == character), None)


def clear() -> None:
    """Remove all evaluations."""
    _evaluations.clear()


def remove(mesh_object: bpy.types.Object) -> None:
    """Remove the last evaluation of an object, because its model has changed."""
    _evaluations.pop(mesh_object.session_uid, None)
