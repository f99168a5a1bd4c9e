# SPDX-License-Identifier: GPL-3.0-or-later
"""A recording that is split into linear skinning and residuals, which are computed when they are read.

The joints and controls that influence each partition are detected (Bailey et al. 2018, section 3.3) in poses in which
one input is moved alone, from the rest pose and from random poses.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ..mathematics.blocks import block_slices
from ..mathematics.features import FLOAT32_ROUNDING_RATIO
from ..mathematics.key_joints import KeyJointReport
from ..mathematics.partition import (
    INFLUENCE_TOLERANCE,
    Partition,
    assume_nearby_influences,
    make_merged_partitions,
)
from ..mathematics.poses import CONTROL
from ..mathematics.skin_fit import SkinFit
from ..mathematics.skinning import LinearSkinning, SkinBlock, skin_matrices
from ..rig import STATIC_JOINT_LABEL, Fingerprint, Rig
from ..settings import MIN_VERTICES_PER_PART
from ..wording import format_count
from .arrays import release_pages
from .index import ALONE, JOINT, RecordingInfo
from .reader import Recording


@dataclass(frozen=True)
class SkinnedRecording:
    """The poses of a recording, its linear skinning, and its partitions with their influences.

    Poses in which one input was moved alone are left out, also from `info`.

    Attributes:
        path: the folder of the recording.
        info: pose counts and origin.
        rig: the rig with the joints and the skin weights of the model.
        partitions: partitions of the mesh.
        pose_matrices: (N, J, 4, 4) float32, mesh-object space, mesh units.
        controls: (N, C) float32, values of the controls of the rig, each in the unit of its property.
        recorded_positions: (M, V, 3) float32 memory map of all recorded poses, mesh-object space, mesh units.
        rows: (N,) int64, rows of the poses in `recorded_positions`.
        fit: fit of the skin weights; None where they are the rig's own.
        key_joints: choice of key joints; None where the model reads all joints without a choice.
    """

    path: Path
    info: RecordingInfo
    rig: Rig
    partitions: tuple[Partition, ...]
    pose_matrices: np.ndarray
    controls: np.ndarray
    recorded_positions: np.ndarray
    rows: np.ndarray
    fit: SkinFit | None = None
    key_joints: KeyJointReport | None = None

    @cached_property
    def skinning(self) -> LinearSkinning:
        """Linear skinning of the rig."""
        return LinearSkinning(self.rig, self.partitions)

    def digest(self) -> str:
        """Hash what networks depend on besides the rig: kind of the fit, joints, partitions and influences.

        Fitted weights are left out: another number of threads changes their last digits.
        """
        partitions = [(p.joint, p.influencing, p.controls, p.merged, len(p.vertices)) for p in self.partitions]
        return Fingerprint.digest_text(repr((self.fit and self.fit.kind, self.rig.joint_names, partitions)))

    def read_positions(self, poses: np.ndarray) -> np.ndarray:
        """Read the (n, V, 3) float32 positions of n poses, mesh-object space, mesh units."""
        return np.array(self.recorded_positions[self.rows[poses]])

    def compute_residuals(self, poses: np.ndarray) -> np.ndarray:
        """Compute the (n, V, 3) float32 local residuals of n poses, axes of the main joints, mesh units."""
        return self.skinning.local_residuals(self.pose_matrices[poses], self.read_positions(poses))

    def iterate_residuals(self, poses: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the (V, 3) float32 local residuals of each pose; a block of poses is in memory."""
        for block in block_slices(len(poses), 8 * self.rig.vertex_count):
            yield from self.compute_residuals(poses[block])

    def compute_partition_residuals(
        self, partition: Partition, poses: np.ndarray | None = None, vertices: np.ndarray | None = None
    ) -> np.ndarray:
        """Compute the local residuals of one partition, a block of poses at a time.

        Args:
            poses: (n,) indices of poses; None for all.
            vertices: (v,) indices of some of its vertices; None for all.

        Returns:
            (n, v, 3) float32, axes of the main joint, mesh units.
        """
        poses = np.arange(len(self.rows)) if poses is None else poses
        vertices = partition.vertices if vertices is None else vertices
        block = SkinBlock(self.rig, partition.joint, vertices)
        residuals = np.empty((len(poses), len(vertices), 3), np.float32)
        for rows in block_slices(len(poses), max(3 * len(vertices), 16 * len(self.rig.joints))):
            residuals[rows] = self.recorded_positions[np.ix_(self.rows[poses[rows]], vertices)]
            skin = skin_matrices(self.pose_matrices[poses[rows]], self.rig.rest_matrices)[:, :, :3]
            block.subtract_from(residuals[rows], skin)
        return residuals


def skin_recording(
    recording: Recording,
    rig: Rig | None = None,
    joints: np.ndarray | None = None,
    follows: tuple[np.ndarray, np.ndarray] | None = None,
    min_vertices_per_part: int = MIN_VERTICES_PER_PART.default,
    influence_tolerance: float = INFLUENCE_TOLERANCE,
    note: Callable[[str], None] = lambda text: None,
) -> SkinnedRecording:
    """Split a recording into linear skinning and residuals, and find partitions and their influences.

    The result depends on no refined pose, so that a training can be continued on a recording that has grown.

    Args:
        recording: a recording with J joints and C controls.
        rig: the rig with K of the joints and the skin weights of linear skinning; None for the recorded rig.
        joints: (K,) indices of these joints in the recording; None for all.
        follows: the (V, J) vertices on which each joint acts that the model does not read, and the (J + C, K + C)
            inputs of the model from which each input of the recording follows, both bool; None if it reads all.
        min_vertices_per_part: partitions with fewer vertices are merged into others; 0 to merge no partitions.
        influence_tolerance: as in `detect_influences`.
        note: receives a note about positions that are not finite.
    """
    rig = recording.rig if rig is None else rig
    joints = np.arange(len(rig.joints)) if joints is None else joints
    partitions = make_merged_partitions(rig, min_vertices_per_part)
    influences = np.zeros((len(partitions), len(recording.rig.joints) + len(rig.controls)), bool)
    if recording.info.alone is None:
        # A target that depends on time does not follow a moved joint immediately: influences cannot be detected.
        partitions = assume_nearby_influences(rig, partitions)
    else:
        influences, text = detect_influences(recording, rig, joints, partitions, influence_tolerance)
        if text:
            note(text)
    if follows:
        acts, inputs = follows
        for partition, influencing in zip(partitions, influences, strict=True):
            influencing[: acts.shape[1]] |= acts[partition.vertices].any(axis=0)
        influences = influences @ inputs
    # The poses that move one input alone are not read again.
    release_pages(recording.positions)
    info, rows = recording.info, np.delete(np.arange(recording.info.poses), recording.info.alone_poses)
    sources = tuple(source for source in info.sampling.sources if source.kind != ALONE)
    return SkinnedRecording(
        recording.path,
        replace(info, poses=len(rows), complete=len(rows), sampling=replace(info.sampling, sources=sources)),
        rig,
        tuple(_add_influences(*each, len(joints)) for each in zip(partitions, influences, strict=True)),
        np.array(recording.pose_matrices[rows])[:, joints],
        np.array(recording.controls[rows]),
        recording.positions,
        rows,
    )


BATCH_BYTES = 6 << 20
"""Bytes of the positions of the poses whose residuals are computed together."""


def detect_influences(
    recording: Recording, rig: Rig, joints: np.ndarray, partitions: tuple[Partition, ...], tolerance: float
) -> tuple[np.ndarray, str]:
    """Detect which inputs of the recording change the residuals of which partitions.

    Args:
        recording: a recording with J joints, C controls and poses in which an input moves alone.
        rig: the rig with K of the joints and the skin weights of linear skinning.
        joints: (K,) indices of these joints in the recording.
        partitions: P partitions of `rig`.
        tolerance: an input influences a partition when it changes a residual by more than this ratio of the rig's size.

    Returns:
        (P, J + C) bool, and a note about positions that are not finite; empty if there are none.
    """
    alone, joint_count = recording.info.alone, len(recording.rig.joints)
    skinning = LinearSkinning(rig, partitions)
    # Far from the origin, rounding moves vertices, so the threshold must be larger.
    rounding = FLOAT32_ROUNDING_RATIO * float(np.abs(rig.rest_positions).max())
    threshold = max(tolerance * rig.size, 2 * rounding)
    batch_size = max(1, BATCH_BYTES // (12 * rig.vertex_count))
    influences = np.zeros((len(partitions), joint_count + len(rig.controls)), bool)
    influences[:, [joint_count + control for control in alone.undetectable]] = True
    infinite_tests = []

    def residuals(poses: slice) -> np.ndarray:
        matrices = np.array(recording.pose_matrices[poses])[:, joints]
        return skinning.local_residuals(matrices, np.array(recording.positions[poses]))

    # Base pose, first moved pose, and moved inputs of each run.
    stride = len(alone.inputs) + 1
    runs = [(base * stride, base * stride + 1, alone.inputs) for base in range(alone.bases)]
    runs.append((0, alone.first_key_pose, tuple((CONTROL, (key,)) for key in alone.keys)))
    offset = recording.info.alone_poses.start
    for base_index, (base_pose, moved_pose, inputs) in enumerate(runs):
        with np.errstate(invalid="ignore", over="ignore"):
            base = residuals(slice(offset + base_pose, offset + base_pose + 1))
            for start in range(0, len(inputs), batch_size):
                batch, first_pose = inputs[start : start + batch_size], offset + moved_pose + start
                norms = np.linalg.norm(residuals(slice(first_pose, first_pose + len(batch))) - base, axis=2)
                # A position that stops being finite is influenced; one that is not finite in the base pose is unknown.
                is_infinite = ~np.isfinite(norms) & np.isfinite(base).all(axis=2)
                infinite_tests += [
                    (base_index % alone.bases, *batch[index]) for index in np.flatnonzero(is_infinite.any(axis=1))
                ]
                is_changed = (norms > threshold) | is_infinite
                for index, partition in enumerate(partitions):
                    for number in np.flatnonzero(is_changed[:, partition.vertices].any(axis=1)):
                        kind, indices = batch[number]
                        influences[index, [i if kind == JOINT else joint_count + i for i in indices]] = True
    if not infinite_tests:
        return influences, ""
    base_index, kind, indices = infinite_tests[0]
    base_text = f"random pose {base_index}" if base_index else "the rest pose"
    name = recording.rig.joint_names[indices[0]] if kind == JOINT else rig.controls[indices[0]].name
    count_text = format_count(len(infinite_tests), "test")
    return influences, (
        f"Some positions of the rig are not finite in {count_text} of its influences, as when "
        f"'{name or STATIC_JOINT_LABEL}' moves from {base_text}; that counts as an influence. Look for a constraint, "
        "driver or modifier that fails in extreme poses."
    )


def _add_influences(partition: Partition, needed_inputs: np.ndarray, joint_count: int) -> Partition:
    """Return a partition with the inputs of a (J + C,) bool array added to its influences; `joint_count` is J."""
    joints, controls = np.flatnonzero(needed_inputs[:joint_count]), np.flatnonzero(needed_inputs[joint_count:])
    return replace(
        partition,
        influencing=tuple(sorted({*partition.influencing, *joints.tolist()})),
        controls=tuple(sorted({*partition.controls, *controls.tolist()})),
    )
