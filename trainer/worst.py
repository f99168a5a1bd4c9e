# SPDX-License-Identifier: GPL-3.0-or-later
"""What the largest errors of a partition have in common: said in the report, to know what would lower them."""

from dataclasses import asdict, dataclass

import numpy as np

from fdda_addon.core.features import FEATURES_PER_JOINT, joint_features
from fdda_addon.core.partition import Partition
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.refinement import nearest_recorded_distances

from .causes import CORNERS, EVEN, POSES, SHAPES, STEEP
from .data import PreparedPartition, Split, residuals_of
from .deformation import Deformation
from .turns import fit_matrices

WORST = 5e-3
"""The largest errors are this part of those of the held-out vertices, at least one a partition."""
MAX_POSES = 2000
"""Of this many training poses the nearest is looked for."""
BY_SHAPES = 0.5
"""From this part of the squared error on, that the shapes do not reach, shapes are what lacks."""
BY_POSES = 1.5
"""From this ratio of held-out to training errors on, poses are what lacks."""
BY_CORNERS = 1.5
"""From this multiple of the usual distance to the nearest training pose on, the poses are rare ones."""


@dataclass(frozen=True)
class Worst:
    """Of the largest errors of one partition on held-out poses.

    Attributes:
        poses, vertices: how many different ones have them.
        shapes: part of their squares that the shapes do not reach.
        border: part of them at vertices with an edge to another partition, over the part of such vertices among all;
            None where no vertex has one, or no faces are known.
        joint: name of the influencing joint or control that is furthest from its middle in these poses, empty where
            none is; `extreme`: how far, where 1 is the mean over all held-out poses.
        distance: to the nearest training pose, where 1 is the median over all held-out poses.
        training: 99.9th percentile of the held-out errors, over that of the training poses.
        cause: one of `causes.CAUSES`.
    """

    poses: int
    vertices: int
    shapes: float
    border: float | None
    joint: str
    extreme: float
    distance: float
    training: float
    cause: str

    def to_json(self) -> dict:
        return asdict(self)


def find_worst(
    recording: Recording, deformation: Deformation, split: Split, held_out: np.ndarray, on_training: np.ndarray
) -> list[Worst]:
    """Look at the largest errors of each partition.

    Args:
        recording, deformation, split: of the training.
        held_out: (n, V) float32 distances of the held-out poses, metres.
        on_training: (m, V) float32 those of some training poses.
    """
    rig = recording.rig
    training = split.training[:: max(1, len(split.training) // MAX_POSES)]
    inside, known = (
        joint_features(np.array(recording.pose_matrices[poses]), rig.rest_matrices, rig.parents)
        for poses in (split.held_out, training)
    )
    beside = _beside_borders(recording, deformation)
    found = []
    for partition, prepared in zip(deformation.partitions, deformation.prepared, strict=True):
        own = partition.vertices
        errors = held_out[:, own].astype(np.float64)
        count = max(1, round(errors.size * WORST))
        chosen = np.argpartition(errors.ravel(), -count)[-count:]
        poses, vertices = np.unravel_index(chosen, errors.shape)
        joints = list(partition.influencing)
        values, recorded = (f[:, joints].reshape(len(f), -1) for f in (inside, known))
        values, recorded = (
            np.concatenate([array, np.array(recording.controls[rows])[:, list(partition.controls)]], axis=1)
            for array, rows in ((values, split.held_out), (recorded, training))
        )
        near = nearest_recorded_distances(values, recorded) if values.shape[1] else np.zeros(len(values))
        distance = _over(float(near[poses].mean()), float(np.median(near)))
        name, extreme = _furthest(recording, partition, values, recorded, poses)
        shapes = _truncated(recording, partition, prepared, split.held_out, poses, vertices, errors)
        ratio = _over(*(float(np.percentile(e, 99.9)) for e in (errors, on_training[:, own])))
        border = None
        if beside is not None and beside[own].any():
            border = _over(float(beside[own][vertices].mean()), float(beside[own].mean()))
        cause = _cause(shapes, distance, ratio)
        counts = len(np.unique(poses)), len(np.unique(vertices))
        found.append(Worst(*counts, shapes, border, name, extreme, distance, ratio, cause))
    return found


def _cause(shapes: float, distance: float, ratio: float) -> str:
    if shapes >= BY_SHAPES:
        return SHAPES
    if ratio >= BY_POSES:
        return CORNERS if distance >= BY_CORNERS else POSES
    return CORNERS if distance >= BY_CORNERS else STEEP if shapes < BY_SHAPES / 2 else EVEN


def _over(value: float, usual: float) -> float:
    return value / usual if usual > 0 else 1.0


def _beside_borders(recording: Recording, deformation: Deformation) -> np.ndarray | None:
    """(V,) bool, the vertices with an edge to another partition; None where no faces are known."""
    starts, corners = recording.rig.face_starts, recording.rig.face_vertices
    if not len(starts):
        return None
    number = np.zeros(recording.rig.vertex_count, np.int64)
    for index, partition in enumerate(deformation.partitions):
        number[partition.vertices] = index
    ends = np.append(starts[1:], len(corners))
    following = np.arange(len(corners)) + 1
    following[ends - 1] = starts
    across = number[corners] != number[corners[following]]
    beside = np.zeros(len(number), bool)
    beside[corners[across]] = beside[corners[following][across]] = True
    return beside


def _furthest(
    recording: Recording, partition: Partition, values: np.ndarray, recorded: np.ndarray, poses: np.ndarray
) -> tuple[str, float]:
    """The joint or control that the worst poses have in common: name, and how far from its middle."""
    names = [recording.rig.joint_names[joint] for joint in partition.influencing]
    widths = [FEATURES_PER_JOINT] * len(names) + [1] * len(partition.controls)
    names += [recording.rig.controls[control].name for control in partition.controls]
    spread = recorded.std(axis=0, dtype=np.float64)
    used = spread > spread.max(initial=0) * 1e-3
    away = np.zeros(values.shape)
    away[:, used] = ((values - recorded.mean(axis=0, dtype=np.float64))[:, used] / spread[used]) ** 2
    best, parts = ("", 1.0), np.split(away, np.cumsum(widths), axis=1)
    for name, columns in zip(names, parts[:-1], strict=True):
        each = np.sqrt(columns.sum(axis=1))
        extreme = _over(float(each[poses].mean()), float(each.mean()))
        best = max(best, (name, extreme), key=lambda pair: pair[1])
    return best


def _truncated(
    recording: Recording,
    partition: Partition,
    prepared: PreparedPartition,
    held_out: np.ndarray,
    poses: np.ndarray,
    vertices: np.ndarray,
    errors: np.ndarray,
) -> float:
    """The part of the squared errors that the shapes do not reach."""
    different, where = np.unique(poses, return_inverse=True)
    rows = held_out[different]
    left = residuals_of(recording, partition, rows).astype(np.float64)
    if len(prepared.fit.joints):
        turns = prepared.fit.joints.max() >= len(recording.rig.joints)
        matrices = fit_matrices(np.array(recording.pose_matrices[rows]), recording.rig, turns)
        turned = np.linalg.inv(matrices[:, prepared.fit.joints[0], :, :3].astype(np.float64))
        left -= prepared.fit.offsets(matrices) @ turned.transpose(0, 2, 1)
    left -= prepared.basis.residuals(prepared.coefficients[rows]).reshape(left.shape)
    apart = np.linalg.norm(left, axis=2)[where, vertices] * recording.rig.metres_per_unit
    return min(1.0, _over(float((apart**2).sum()), float((errors[poses, vertices] ** 2).sum())))
