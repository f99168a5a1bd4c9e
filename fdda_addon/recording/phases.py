# SPDX-License-Identifier: GPL-3.0-or-later
"""What is known of one mesh after each phase of its recording: planned, then fitted, then found, then recorded.

Each phase takes the value of the one before, so that none can be left out or come too early.
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
from ..rig.temporary_rig_state import Posed
from ..scene.scene_rig import SceneRig


class TimedEvaluator:
    """Evaluates poses, and knows how long that takes."""

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
    def seconds_a_pose(self) -> float | None:
        """Mean so far, None before the first pose."""
        return self._seconds / self._count if self._count else None


@dataclass(frozen=True)
class MeshPlanned:
    """A mesh whose recording is planned.

    Attributes:
        scene_rig, rig: the rig, with the weights of its own.
        path: folder of the recording.
        channels: that move it.
        limits: channels of its recording: those that move the meshes which share its poses included.
        known: folder that may know weights and influences already.
        target: whose surface is recorded; None for that of the rig.
    """

    scene_rig: SceneRig
    rig: Rig
    path: Path
    channels: tuple[Channel, ...]
    limits: tuple[Channel, ...]
    known: Path | None = None
    target: Target | None = None

    @property
    def name(self) -> str:
        """Name of the mesh object."""
        return self.scene_rig.mesh_object.name

    def evaluator(self, rig: Rig) -> PoseEvaluator:
        """Evaluates the poses of the mesh, its weights those of `rig`."""
        return PoseEvaluator(self.scene_rig, rig, self.target)

    @property
    def posed(self) -> Posed:
        """The mesh as `temporary_rig_states` takes it."""
        return self.scene_rig, self.rig, self.channels


@dataclass(frozen=True)
class WeightsFitted:
    """A mesh that has the weights of its linear skinning.

    Attributes:
        planned: the mesh as it was planned.
        rig: with the weights of linear skinning.
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
    """A mesh whose influences are found: its poses can be recorded.

    Attributes:
        fitted: the mesh with the weights of its linear skinning.
        partitions: with what influences them.
        evaluator: of the poses, which knows by now what one takes.
    """

    fitted: WeightsFitted
    partitions: tuple[Partition, ...]
    evaluator: TimedEvaluator


def estimate(meshes: Sequence[InfluencesReady], poses: int, left: int, seconds_a_pose: float | None = None) -> str:
    """A sentence about what poses of some meshes will take; empty without poses.

    Args:
        meshes: which are evaluated together.
        poses: of the complete recordings.
        left: how many of them are still to be recorded.
        seconds_a_pose: what one takes, where more than its evaluation does; of the evaluators where it is left out.
    """
    if not left:
        return ""
    rigs = [found.fitted.rig for found in meshes]
    # Whatever is read of it, all of the scene is evaluated each time.
    times = [seconds_a_pose or found.evaluator.seconds_a_pose for found in meshes]
    seconds = None if None in times else max(times) * left
    size = sum(recording_bytes(rig, poses) for rig in rigs)
    return Estimate(left, sum(rig.vertex_count for rig in rigs), size, seconds).sentence()
