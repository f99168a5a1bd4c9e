# SPDX-License-Identifier: GPL-3.0-or-later
"""Detects the joints and controls that influence each partition (Bailey et al. 2018, section 3.3).

The paper moves one joint at a time. Here joints that do not act on the same patches of the mesh (`core.patches`) are
moved at the same time (`core.group_testing`), from the rest pose and from random poses, each to a value far from its
own in that pose.
"""

from collections.abc import Generator

import numpy as np

from ..core.checks.warning import format_list, joint_name
from ..core.features import FLOAT32_ROUNDING_RATIO
from ..core.group_testing import GroupTesting
from ..core.partition import Partition, make_partitions
from ..core.patches import Patches, divide_into_patches
from ..core.poses import CONTROL
from ..core.progress import Progress
from ..core.rig import Rig
from ..core.skinning import LinearSkinning
from ..rig.reading import PoseEvaluator
from ..scene.bone_transform import controls_by_bone
from ..scene.scene_rig import SceneRig
from .influence_trials import JOINT, InfluenceSearch, Trials, prepared_trials

MAX_BATCH_GROUPS, BATCH_BYTES = 50, 6 << 20
"""Limits of a batch whose residuals are computed together: groups of moved inputs, and bytes of their positions."""
NOT_FINITE_CHANGE = 1e6
"""Change of a vertex whose position is not finite any more, relative to the threshold."""


def detect_influences(
    scene_rig: SceneRig, rig: Rig, partitions: tuple[Partition, ...], evaluator: PoseEvaluator, search: InfluenceSearch
) -> Generator[Progress, None, tuple[Partition, ...]]:
    """Detect the influences on the partitions of a rig while the generator is iterated.

    The caller restores the pose of the armature and the values of sampled controls.

    Yields:
        Progress of the stage "influences". Its total grows when inputs are divided into groups again.

    Returns:
        The partitions with their influencing joints and controls.
    """
    patches = divide_into_patches(rig, partitions)
    with prepared_trials(scene_rig, rig, search) as trials:
        joints_near_patches = patches.nearby_joints(rig)
        nearby = np.zeros((len(trials.inputs), len(patches.starts)), bool)
        for number, (kind, index) in enumerate(trials.inputs):
            if kind == JOINT:
                nearby[number] = joints_near_patches[index]
        evaluation = _GroupEvaluation(rig, partitions, patches, evaluator, search, trials)
        influences = yield from _test_groups(nearby, trials.inputs, evaluation, search.poses)
        if evaluation.infinite_groups:
            yield Progress("influences", 1, 1, _describe_infinite(scene_rig, rig, trials, evaluation.infinite_groups))
    # The first control of a bone stands for all controls of its transform.
    controls_of_bones = {indices[0]: indices for indices in controls_by_bone(rig.controls).values()}
    by_kind: dict[str, dict[int, tuple[int, ...]]] = {JOINT: {}, CONTROL: {}}
    for partition, is_influence in zip(partitions, influences.T, strict=True):
        partition_inputs = {trials.inputs[number] for number in np.flatnonzero(is_influence)}
        controls = {index for kind, index in partition_inputs if kind == CONTROL} & controls_of_bones.keys()
        partition_inputs |= {(CONTROL, index) for control in controls for index in controls_of_bones[control]}
        partition_inputs |= {(CONTROL, control) for control in trials.undetectable_controls}
        for kind, by_joint in by_kind.items():
            by_joint[partition.joint] = tuple(sorted(index for each, index in partition_inputs if each == kind))
    main_joints_of_merged = {joint: partition.joint for partition in partitions for joint in partition.merged}
    return make_partitions(rig, by_kind[JOINT], by_kind[CONTROL], main_joints_of_merged)


def _describe_infinite(scene_rig: SceneRig, rig: Rig, trials: Trials, groups: list[tuple[int, list[int]]]) -> str:
    """Say which inputs, moved together in pairs of trial and group, gave vertices positions that are not finite."""
    trial, group = min(groups, key=lambda pair: len(pair[1]))
    inputs = [trials.inputs[number] for number in group]
    names = [joint_name(rig, index) if kind == JOINT else rig.controls[index].name for kind, index in inputs]
    pose = "the rest pose" if trial == 0 else f"random pose {trial}"
    return (
        f"Some positions of '{scene_rig.mesh_object.name}' are not finite in {len(groups)} tests of its influences, as "
        f"when {format_list(names)} move from {pose}; that counts as an influence. Look for a constraint, driver or "
        "modifier that fails in extreme poses."
    )


def _test_groups(
    nearby: np.ndarray, inputs: list[tuple[str, int]], evaluation: "_GroupEvaluation", trial_count: int
) -> Generator[Progress, None, np.ndarray]:
    """Test groups of N inputs in each trial; return the influences on P partitions, (N, P) bool."""
    if not inputs:
        return evaluation.patches.any_of_partition(nearby)
    testing = GroupTesting(nearby, np.array([kind for kind, _ in inputs]), evaluation.patches)
    for trial in range(trial_count):
        testing.start_trial()
        while groups := testing.next_groups():
            testing.add_changes(groups, (yield from evaluation.evaluate(trial, groups)))
    return testing.influences


class _GroupEvaluation:
    """Evaluates groups of moved inputs, and counts the evaluations.

    Attributes:
        infinite_groups: trial and moved inputs where finite positions became others.
    """

    def __init__(
        self,
        rig: Rig,
        partitions: tuple[Partition, ...],
        patches: Patches,
        evaluator: PoseEvaluator,
        search: InfluenceSearch,
        trials: Trials,
    ):
        self.patches, self._evaluator, self._trials = patches, evaluator, trials
        self._skinning = LinearSkinning(rig, partitions)
        # Far from the origin, rounding moves vertices, so the threshold must be larger.
        self._threshold = max(
            search.tolerance * rig.size, 2 * FLOAT32_ROUNDING_RATIO * float(np.abs(rig.rest_positions).max())
        )
        self._batch_size = max(1, min(MAX_BATCH_GROUPS, BATCH_BYTES // (12 * rig.vertex_count)))
        self._base_residuals: dict[int, np.ndarray] = {}
        self._done, self._counts = 0, [0] * search.poses
        self.infinite_groups: list[tuple[int, list[int]]] = []

    def evaluate(self, trial: int, groups: list[np.ndarray]) -> Generator[Progress, None, np.ndarray]:
        """Evaluate groups in a trial; return the change of each vertex relative to the threshold, sorted by patch.

        Returns:
            (G, V, 3) float32, axes of the main joints.
        """
        self._counts[trial] += len(groups) + (trial not in self._base_residuals)
        if trial not in self._base_residuals:
            self._trials.show(trial, ())
            self._base_residuals[trial] = self._residuals([self._evaluator.evaluate()[:2]])
            yield self._progress()
        changes, evaluated_poses = [], []
        for number, group in enumerate(groups, 1):
            self._trials.show(trial, group.tolist())
            evaluated_poses.append(self._evaluator.evaluate()[:2])
            if len(evaluated_poses) == self._batch_size or number == len(groups):
                batch = (self._residuals(evaluated_poses) - self._base_residuals[trial]) / self._threshold
                if not np.isfinite(batch).all():
                    self._replace_infinite(trial, groups[number - len(batch) : number], batch)
                changes.append(self.patches.sort(batch))
                evaluated_poses = []
            yield self._progress()
        return np.concatenate(changes)

    def _replace_infinite(self, trial: int, groups: list[np.ndarray], changes: np.ndarray) -> None:
        """Replace changes, (n, V, 3), that are not finite; where the base pose is not finite, nothing is known."""
        is_known = np.isfinite(self._base_residuals[trial][0])
        is_lost = is_known & ~np.isfinite(changes)
        self.infinite_groups += [(trial, groups[index].tolist()) for index in np.flatnonzero(is_lost.any(axis=(1, 2)))]
        changes[is_lost] = NOT_FINITE_CHANGE
        changes[:, ~is_known] = 0

    def _progress(self) -> Progress:
        self._done += 1
        # The trials to come are as long as the longest so far.
        total = sum(self._counts) + self._counts.count(0) * max(self._counts)
        return Progress("influences", self._done, total)

    def _residuals(self, evaluated_poses: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        return self._skinning.local_residuals(*(np.stack(arrays) for arrays in zip(*evaluated_poses, strict=True)))
