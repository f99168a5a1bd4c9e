# SPDX-License-Identifier: GPL-3.0-or-later
"""What is recorded of one mesh: its rig, what influences it, its folder."""

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .core.partition import Partition, merged_partitions
from .core.poses import Channel
from .core.progress import Progress
from .core.recording_estimate import Estimate, recording_bytes
from .core.rig import Rig
from .core.skin_fit import SkinFit
from .influences import Search, find_influences
from .scene.borrowed_rig import Posed
from .scene.rig import PoseEvaluator, SceneRig


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


@dataclass
class Recorder:
    """A mesh that is recorded.

    Attributes:
        scene_rig, rig: the rig; its weights are those of the linear layer.
        path: folder of the recording.
        channels: that move it.
        limits: channels of its recording: those that move the meshes which share its poses included.
        fit: of the weights, where they are fitted.
        partitions: with what influences them, once it is found.
        evaluator: of the poses.
    """

    scene_rig: SceneRig
    rig: Rig
    path: Path
    channels: tuple[Channel, ...]
    limits: tuple[Channel, ...] = ()
    fit: SkinFit | None = None
    partitions: tuple[Partition, ...] = ()
    evaluator: TimedEvaluator | None = None

    @property
    def name(self) -> str:
        """Of the mesh object."""
        return self.scene_rig.mesh_object.name

    @property
    def posed(self) -> Posed:
        """As `borrowed_rigs` takes it."""
        return self.scene_rig, self.rig, self.channels

    def find_influences(self, search: Search, least_vertices: int) -> Iterator[Progress]:
        """Fill in `partitions`; the scene is borrowed."""
        self.evaluator = TimedEvaluator(PoseEvaluator(self.scene_rig, self.rig))
        cut = merged_partitions(self.rig, least_vertices)
        self.partitions = yield from find_influences(self.scene_rig, self.rig, cut, self.evaluator, search)


def in_turn(recorders: list[Recorder], work: Callable[[Recorder], Iterator[Progress]]) -> Iterator[Progress]:
    """Do some work for each mesh; where there are several, the stages say for which."""
    for recorder in recorders:
        with contextlib.closing(work(recorder)) as steps:
            for step in steps:
                yield step if len(recorders) == 1 else replace(step, stage=f"{step.stage} of '{recorder.name}'")


def estimate(recorders: list[Recorder], poses: int, left: int) -> str:
    """A sentence about what poses of some meshes will take, once their influences are found; empty without poses.

    Args:
        recorders: of the meshes, which are evaluated together.
        poses: of the complete recordings.
        left: how many of them are still to be recorded.
    """
    if not left:
        return ""
    size = sum(recording_bytes(recorder.rig, poses) for recorder in recorders)
    # Whatever is read of it, all of the scene is evaluated each time.
    times = [recorder.evaluator.seconds_a_pose for recorder in recorders]
    seconds = None if None in times else max(times) * left
    vertices = sum(recorder.rig.vertex_count for recorder in recorders)
    return Estimate(left, vertices, size, seconds).sentence()
