# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses the poses of a recording to which skin weights are fitted, and by which key joints are chosen."""

from dataclasses import dataclass, replace

import numpy as np

from fdda_addon.core.errors import RecordingError
from fdda_addon.core.mathematics.poses import CONTROL
from fdda_addon.core.recording.index import ALONE, RANDOM, REFINED
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.rig import Joint, Rig

MIN_POSES = 10
"""Smallest number of poses of a fit, half of which are held out."""
MAX_FIT_POSES = 300
MAX_FIT_BYTES = 256 << 20
"""Largest number of poses to which weights are fitted, and largest size of their positions, unless that is less than
the smallest number of poses."""
MIN_RANDOM_POSES = 40
"""Smallest number of random poses by which key joints are chosen."""


@dataclass(frozen=True)
class FitPoses:
    """Poses to which skin weights are fitted.

    Attributes:
        rig: the rig with its own skin weights.
        pose_matrices: (n, J, 4, 4) float32, mesh-object space, mesh units.
        positions: (n, V, 3) float32 positions that the rig evaluates, mesh-object space, mesh units.
        controls: (n, C) float32 values of the controls.
        is_dependency: (J,) bool, joints that move the mesh otherwise than by skin weights.
        is_sampled: (J,) bool, joints that random poses move by channels of their own.
        random_count: number of random poses, which come first.
    """

    rig: Rig
    pose_matrices: np.ndarray
    positions: np.ndarray
    controls: np.ndarray
    is_dependency: np.ndarray
    is_sampled: np.ndarray
    random_count: int = 0

    def subset(self, poses: slice) -> "FitPoses":
        """Return the poses of a slice."""
        arrays = {name: getattr(self, name)[poses] for name in ("pose_matrices", "positions", "controls")}
        return replace(self, **arrays)

    def of_vertices(self, vertices: np.ndarray) -> "FitPoses":
        """Return the poses of the (v,) vertices."""
        arrays = {name: getattr(self.rig, name)[vertices] for name in ("rest_positions", "skin_joints", "skin_weights")}
        return replace(self, rig=replace(self.rig, **arrays), positions=self.positions[:, vertices])

    def with_joints(self, joints: np.ndarray) -> "FitPoses":
        """Return the poses of the joints with (K,) ascending indices; they have no parents, and their own weights."""
        indices = np.zeros(len(self.rig.joints), np.int32)
        indices[joints] = np.arange(len(joints))
        is_selected = np.isin(self.rig.skin_joints, joints)
        rig = replace(
            self.rig,
            joints=tuple(Joint(self.rig.joints[joint].name, -1) for joint in joints),
            rest_matrices=self.rig.rest_matrices[joints],
            skin_joints=np.where(is_selected, indices[self.rig.skin_joints], 0),
            skin_weights=np.where(is_selected, self.rig.skin_weights, 0),
        )
        return replace(
            self,
            rig=rig,
            pose_matrices=self.pose_matrices[:, joints],
            is_dependency=self.is_dependency[joints],
            is_sampled=self.is_sampled[joints],
        )


def read_fit_poses(recording: Recording, has_key_joints: bool, vertices: np.ndarray | None = None) -> FitPoses:
    """Read the poses of a fit. Refined poses are none of them, so a recording that grows has the same fit.

    Args:
        has_key_joints: key joints are chosen, which takes random poses.
        vertices: (v,) indices of the vertices that are read; None for all.

    Raises:
        RecordingError: there are too few poses.
    """
    sources = recording.info.sampling.sources
    pose_count = sum(source.poses for source in sources if source.kind not in (ALONE, REFINED))
    random_count = sum(source.poses for source in sources if source.kind == RANDOM) if has_key_joints else 0
    # Frames of actions do not show which joints can move independently.
    if has_key_joints and random_count < MIN_RANDOM_POSES:
        raise RecordingError(
            f"Key joints are chosen by at least {MIN_RANDOM_POSES} random poses, and the recording has {random_count}; "
            "record more (--poses), or leave --bones-to-read out."
        )
    vertex_count = recording.rig.vertex_count if vertices is None else len(vertices)
    poses = choose_fit_poses(pose_count, vertex_count, random_count)
    return select_poses(recording, poses, vertices, int((poses < random_count).sum()))


def select_poses(
    recording: Recording, poses: np.ndarray, vertices: np.ndarray | None = None, random_count: int = 0
) -> FitPoses:
    """Read poses of a recording.

    Args:
        poses: (n,) indices of the poses.
        vertices: indices of the vertices to read; None for all.
        random_count: number of random poses, which come first.
    """
    rig, roles = recording.rig, np.zeros((2, len(recording.rig.joints)), bool)
    roles[0, list(recording.info.bones.dependencies)] = True
    sampled = {channel.name for channel in recording.info.sampling.channels if channel.kind != CONTROL}
    roles[1] = [name in sampled for name in rig.joint_names]
    matrices, controls = (np.array(array[poses]) for array in (recording.pose_matrices, recording.controls))
    fit_poses = FitPoses(rig, matrices, recording.positions[:0], controls, *roles, random_count)
    if vertices is None:
        return replace(fit_poses, positions=np.array(recording.positions[poses]))
    positions = np.stack([recording.positions[pose][vertices] for pose in poses])
    return replace(fit_poses.of_vertices(vertices), positions=positions)


def choose_fit_poses(pose_count: int, vertex_count: int, random_count: int = 0) -> np.ndarray:
    """Choose evenly spaced poses of a recording to fit weights to, and return their ascending indices.

    Args:
        pose_count: number of poses of the recording.
        vertex_count: number of vertices.
        random_count: number of random poses, the first of the recording, if key joints are chosen: two thirds of the
            chosen poses are random. 0 to choose among all poses.

    Raises:
        RecordingError: there are too few poses.
    """
    if pose_count < MIN_POSES:
        raise RecordingError(
            f"Skin weights are fitted to at least {MIN_POSES} poses, and the recording has {pose_count}; record more, "
            "or leave --base-skinning out."
        )
    min_pose_count = 3 * MIN_RANDOM_POSES // 2 if random_count else MIN_POSES
    fit_pose_count = min(pose_count, MAX_FIT_POSES, max(min_pose_count, MAX_FIT_BYTES // (12 * vertex_count)))
    chosen_random_count = min(random_count, max(2 * fit_pose_count // 3, fit_pose_count - (pose_count - random_count)))
    parts = ((0, random_count, chosen_random_count), (random_count, pose_count, fit_pose_count - chosen_random_count))
    return np.concatenate(
        [np.linspace(start, end - 1, min(count, end - start)).round().astype(int) for start, end, count in parts]
    )
