# SPDX-License-Identifier: GPL-3.0-or-later
"""Defines a mesh of a recording session: its rig, its folder, and what the phases of the session find."""

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..core.mathematics.partition import Partition
from ..core.mathematics.poses import Channel
from ..core.mathematics.skin_fit import SkinFit
from ..core.rig import Rig
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


@dataclass(eq=False)
class RecordedMesh:
    """A mesh of a `RecordingSession`.

    Attributes:
        scene_rig: the rig as scene objects.
        rig: the rig as arrays; `fit_weights` replaces its skin weights, and may remove joints. `find_influences` sets
            reference joints.
        note: a sentence for the user about the rig; may be empty.
        original_rig: the rig with its own skin weights and all joints.
        path: folder of the recording.
        channels: channels of the random poses that belong to the mesh or its armature.
        limits: channels of the recording, including shared channels of other meshes.
        previous_path: folder of a recording whose weights and influences are reused; None if there is none.
        target: the target whose surface is recorded; None for the rig itself.
        fit: result of `fit_weights`; None if the weights are the rig's own.
        needed_inputs: as in `weight_fitting.FittedWeights`.
        partitions: the partitions with their influencing joints and controls, from `find_influences`.
        evaluator: evaluates the mesh for `find_influences` and all poses.
    """

    scene_rig: SceneRig
    rig: Rig
    path: Path
    channels: tuple[Channel, ...]
    limits: tuple[Channel, ...]
    previous_path: Path | None
    target: Target | None
    note: str = ""
    fit: SkinFit | None = None
    needed_inputs: np.ndarray | None = None
    partitions: tuple[Partition, ...] = ()
    evaluator: TimedEvaluator = field(init=False)
    original_rig: Rig = field(init=False)

    def __post_init__(self):
        self.original_rig = self.rig

    @property
    def name(self) -> str:
        """Return the name of the mesh object."""
        return self.scene_rig.mesh_object.name

    def make_evaluator(self) -> PoseEvaluator:
        """Make an evaluator of the joints that the rig has in this phase."""
        return PoseEvaluator(self.scene_rig, self.rig, self.target)

    @property
    def posed_rig(self) -> PosedRig:
        """Return the rig and its channels, as `temporary_rig_states` needs them."""
        return self.scene_rig, self.rig, self.channels
