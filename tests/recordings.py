# SPDX-License-Identifier: GPL-3.0-or-later
"""Recordings with given residuals and influences, for tests."""

from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.mathematics.poses import CONTROL
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.index import ALONE, JOINT, REFINED, AloneMoves, RecordingInfo, Source
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import SkinnedRecording, skin_recording
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.core.rig import Rig


@dataclass(frozen=True)
class ResidualRecording(SkinnedRecording):
    """A recording in memory with given `residuals`, (N, V, 3) float32, axes of the main joint, mesh units."""

    residuals: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float32))

    def read_positions(self, poses: np.ndarray) -> np.ndarray:
        return self.skinning.complex_positions(self.pose_matrices[poses], self.residuals[poses])

    def compute_residuals(self, poses: np.ndarray) -> np.ndarray:
        return np.array(self.residuals[poses])

    def compute_partition_residuals(
        self, partition: Partition, poses: np.ndarray | None = None, vertices: np.ndarray | None = None
    ) -> np.ndarray:
        residuals = self.residuals if poses is None else self.residuals[poses]
        return np.asarray(residuals[:, partition.vertices if vertices is None else vertices], np.float32)


def make_recording(
    path: Path,
    info: RecordingInfo,
    rig: Rig,
    partitions: tuple[Partition, ...],
    pose_matrices: np.ndarray,
    residuals: np.ndarray,
    controls: np.ndarray,
) -> ResidualRecording:
    """Make a recording in memory."""
    rows = np.arange(len(residuals))
    arrays = pose_matrices, controls, np.zeros((0, rig.vertex_count, 3)), rows
    return ResidualRecording(path, info, rig, partitions, *arrays, residuals=residuals)


def read_skinned(path: Path, **settings: float) -> ResidualRecording:
    """Read a recording with all its residuals; `settings` as for `skin_recording`."""
    skinned = skin_recording(read_recording(path), **settings)
    residuals = skinned.compute_residuals(np.arange(len(skinned.rows)))
    return ResidualRecording(
        **{member.name: getattr(skinned, member.name) for member in fields(SkinnedRecording)}, residuals=residuals
    )


def write_recording(
    path: Path,
    rig: Rig,
    partitions: tuple[Partition, ...],
    info: RecordingInfo,
    pose_matrices: np.ndarray,
    residuals: np.ndarray,
    controls: np.ndarray | None = None,
) -> None:
    """Write a recording with residuals and with poses in which each input changes the partitions that it influences."""
    positions = LinearSkinning(rig, partitions).complex_positions(pose_matrices, residuals)
    with RecordingWriter(path, rig, with_influences(info, rig)) as writer:
        end = sum(source.poses for source in info.sampling.sources if source.kind != REFINED)
        arrays = [(pose_matrices, positions, controls), alone_arrays(rig, partitions)]
        parts = [
            [array[poses] if array is not None else None for array in arrays[0]]
            for poses in (slice(0, end), slice(end, None))
        ]
        is_complete = len(pose_matrices) == info.poses
        for part in (parts[0], *([arrays[1]] if is_complete else []), parts[1]):
            if len(part[0]) and writer.complete < writer.info.poses:
                writer.append(*part)


def with_influences(info: RecordingInfo, rig: Rig) -> RecordingInfo:
    """Return an index with the poses of `alone_arrays` after all poses but the refined ones."""
    inputs = [(JOINT, (joint,)) for joint in range(len(rig.joints))]
    inputs += [(CONTROL, (control,)) for control in range(len(rig.controls))]
    alone = AloneMoves(2, tuple(inputs))
    sources = sorted([*info.sampling.sources, Source(ALONE, alone.poses)], key=lambda source: source.kind == REFINED)
    sampling = replace(info.sampling, sources=tuple(sources))
    return replace(info, poses=info.poses + alone.poses, sampling=sampling, alone=alone)


def alone_arrays(rig: Rig, partitions: tuple[Partition, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return pose matrices, positions and controls of poses in which each input moves alone, from two base poses.

    An input changes what it influences in the moves from the second base pose, and nothing in those from the first.
    """
    joint_count, control_count = len(rig.joints), len(rig.controls)
    stride = 1 + joint_count + control_count
    matrices = np.repeat(rig.rest_matrices[None], 2 * stride, axis=0)
    positions = LinearSkinning(rig, partitions).positions(matrices)
    for partition in partitions:
        inputs = [*partition.influencing, *(joint_count + control for control in partition.controls)]
        positions[np.ix_([stride + 1 + number for number in inputs], partition.vertices)] += rig.size
    return matrices, positions, np.zeros((len(matrices), control_count), np.float32) if control_count else None
