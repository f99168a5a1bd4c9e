# SPDX-License-Identifier: GPL-3.0-or-later
"""State of a mesh after each phase of its recording: planned, weights fitted, influences ready.

Each phase takes the state of the previous one, so that no phase can be skipped.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.partition import Partition
from ..core.poses import Channel
from ..core.recording.estimate import Estimate, recording_bytes
from ..core.rig import Rig
from ..core.skin_fit import SkinFit
from ..rig.reading import PoseEvaluator
from ..rig.target import Target
from ..rig.temporary_rig_state import PosedRig
from ..scene.scene_rig import SceneRig


class TimedEvaluator:
    """Evaluates poses and measures the time."""

    def __init__(self, evaluator: PoseEvaluator):
        self._evaluator = evaluator
        self._count, self._seconds = 0, 0.0

    def evaluate(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `PoseEvaluator.evaluate`."""
        start = time.perf_counter()
        evaluated = self._evaluator.evaluate()
        self._seconds += time.perf_counter() - start
        self._count += 1
        return evaluated

    @property
    def seconds_per_pose(self) -> float | None:
        """Mean time of a pose in seconds; None before the first one."""
        return self._seconds / self._count if self._count else None


@dataclass(frozen=True)
class MeshPlanned:
    """A mesh whose recording is planned.

    Attributes:
        scene_rig, rig: the rig, with its own skin weights.
        path: folder of the recording.
        channels: of the mesh.
        limits: channels of the recording, with those of meshes that share its poses.
        previous_path: folder of a recording with weights and influences; None where there is none.
        target: whose surface is recorded; None for the rig itself.
    """

    scene_rig: SceneRig
    rig: Rig
    path: Path
    channels: tuple[Channel, ...]
    limits: tuple[Channel, ...]
    previous_path: Path | None = None
    target: Target | None = None

    @property
    def name(self) -> str:
        """Name of the mesh object."""
        return self.scene_rig.mesh_object.name

    def evaluator(self, rig: Rig) -> PoseEvaluator:
        """Make the evaluator of the poses of the mesh, with the skin weights of `rig`."""
        return PoseEvaluator(self.scene_rig, rig, self.target)

    @property
    def posed_rig(self) -> PosedRig:
        """The argument for `temporary_rig_states`."""
        return self.scene_rig, self.rig, self.channels


@dataclass(frozen=True)
class WeightsFitted:
    """A mesh with the skin weights of its linear skinning.

    Attributes:
        planned: the state before.
        rig: with the skin weights of linear skinning.
        fit: of the weights; None where they are the rig's own.
    """

    planned: MeshPlanned
    rig: Rig
    fit: SkinFit | None

    @property
    def name(self) -> str:
        """Name of the mesh object."""
        return self.planned.name


@dataclass(frozen=True)
class InfluencesReady:
    """A mesh with influences, whose poses can be recorded.

    Attributes:
        fitted: the state before.
        partitions: with their influencing joints and controls.
        evaluator: of the poses, which has measured the time of a pose.
    """

    fitted: WeightsFitted
    partitions: tuple[Partition, ...]
    evaluator: TimedEvaluator


def describe_estimate(
    meshes: Sequence[InfluencesReady], poses: int, remaining: int, seconds_per_pose: float | None = None
) -> str:
    """Describe the remaining work of recordings; empty without remaining poses.

    Args:
        meshes: that are evaluated together.
        poses: number of poses of a complete recording.
        remaining: number of poses still to be recorded.
        seconds_per_pose: time of a pose; measured by the evaluators by default.
    """
    if not remaining:
        return ""
    rigs = [mesh.fitted.rig for mesh in meshes]
    # The whole scene is evaluated for each pose, so the times of meshes do not add up.
    times = [seconds_per_pose or mesh.evaluator.seconds_per_pose for mesh in meshes]
    seconds = None if None in times else max(times) * remaining
    size = sum(recording_bytes(rig, poses) for rig in rigs)
    return Estimate(remaining, sum(rig.vertex_count for rig in rigs), size, seconds).sentence()
