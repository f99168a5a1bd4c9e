# SPDX-License-Identifier: GPL-3.0-or-later
"""Defines the state of a mesh after each phase of its recording: planned, weights fitted, influences ready.

Each phase needs the state that the previous phase returns, so no phase can be skipped.
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
    """Evaluates poses and measures how long an evaluation takes."""

    def __init__(self, evaluator: PoseEvaluator):
        self._evaluator = evaluator
        self._pose_count, self._seconds = 0, 0.0

    def evaluate(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Evaluate the current pose, as `PoseEvaluator.evaluate` does."""
        start_time = time.perf_counter()
        arrays = self._evaluator.evaluate()
        self._seconds += time.perf_counter() - start_time
        self._pose_count += 1
        return arrays

    @property
    def seconds_per_pose(self) -> float | None:
        """Return the mean time of an evaluation in seconds; None before the first evaluation."""
        return self._seconds / self._pose_count if self._pose_count else None


@dataclass(frozen=True)
class MeshPlanned:
    """A mesh whose recording is planned.

    Attributes:
        scene_rig, rig: the rig as scene objects, and as arrays with its own skin weights.
        path: folder of the recording.
        channels: channels of the random poses that belong to the mesh or its armature.
        limits: channels of the recording, including shared channels of other meshes.
        previous_path: folder of a recording whose weights and influences are reused; None if there is none.
        target: the target whose surface is recorded; None for the rig itself.
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
        """Return the name of the mesh object."""
        return self.scene_rig.mesh_object.name

    def evaluator(self, rig: Rig) -> PoseEvaluator:
        """Make an evaluator of the poses of the mesh, for a rig with the final skin weights."""
        return PoseEvaluator(self.scene_rig, rig, self.target)

    @property
    def posed_rig(self) -> PosedRig:
        """Return the rig and its channels, as `temporary_rig_states` needs them."""
        return self.scene_rig, self.rig, self.channels


@dataclass(frozen=True)
class WeightsFitted:
    """A mesh with the skin weights of its linear skinning.

    Attributes:
        planned: the state after the previous phase.
        rig: the rig with the skin weights of linear skinning.
        fit: result of the fit; None if the weights are the rig's own.
        needed_inputs: as in `weight_fitting.FittedWeights`.
    """

    planned: MeshPlanned
    rig: Rig
    fit: SkinFit | None
    needed_inputs: np.ndarray | None = None

    @property
    def name(self) -> str:
        """Return the name of the mesh object."""
        return self.planned.name


@dataclass(frozen=True)
class InfluencesReady:
    """A mesh with influences, whose poses can be recorded.

    Attributes:
        fitted: the state after the previous phase.
        partitions: the partitions with their influencing joints and controls.
        evaluator: the evaluator of the poses, which also measures the time of a pose.
    """

    fitted: WeightsFitted
    partitions: tuple[Partition, ...]
    evaluator: TimedEvaluator


def describe_estimate(
    meshes: Sequence[InfluencesReady], pose_count: int, remaining_count: int, seconds_per_pose: float | None = None
) -> str:
    """Describe the remaining work of recordings; return an empty text if no poses remain.

    Args:
        meshes: the meshes that are evaluated together.
        pose_count: number of poses of a complete recording.
        remaining_count: number of poses that are not recorded yet.
        seconds_per_pose: time of a pose; measured by the evaluators by default.
    """
    if not remaining_count:
        return ""
    rigs = [mesh.fitted.rig for mesh in meshes]
    # The whole scene is evaluated for each pose, so the times of meshes do not add up.
    seconds_per_pose_of_meshes = [seconds_per_pose or mesh.evaluator.seconds_per_pose for mesh in meshes]
    remaining_seconds = (
        None if None in seconds_per_pose_of_meshes else max(seconds_per_pose_of_meshes) * remaining_count
    )
    total_bytes = sum(recording_bytes(rig, pose_count) for rig in rigs)
    return Estimate(remaining_count, sum(rig.vertex_count for rig in rigs), total_bytes, remaining_seconds).sentence()
