# SPDX-License-Identifier: GPL-3.0-or-later
"""Group testing: finds which inputs influence which parts, by changing several inputs at the same time.

If a group of inputs does not change a part, none of its members does. If it does, its members are tested in other
groups until only one can be the cause. This is adaptive combinatorial group testing (Du and Hwang, 1999).
"""

from dataclasses import dataclass

import numpy as np

GROUPS_PER_INFLUENCE = 3
"""Ratio of the number of groups to the mean number of likely influences on a part. In fewer groups, more groups of a
part have a known influence, which hides another one."""
SECOND_NEARBY_WEIGHT = 0.01
"""Weight of a conflict between inputs that are near the same parts only through another input, relative to a conflict
between nearby inputs."""
CLEAR_TRIALS = 2
"""Number of trials, or all if there are fewer, in which each pair of input and part is tested without a known influence
on the part. An input may influence the part in one pose and not in another."""
MIN_MARGINAL_CHANGE = 0.5
"""Smallest change of a part, relative to the threshold, that may be above the threshold in another group: the changes
of the members of a group add up or cancel each other."""
SPLIT_GROUPS = 3
"""Smallest number of groups into which the members of a group are split."""


@dataclass(frozen=True)
class _Answer:
    """The parts that a group of inputs changed in a trial: (G,) indices of inputs, and (P,) bool."""

    trial: int
    group: np.ndarray
    parts: np.ndarray


class GroupTesting:
    """Finds the influences of N inputs on P parts in T trials.

    In a trial each input changes from the same state to the same value, in every group. The groups are the classes of a
    coloring of the graph that connects inputs which are likely to influence the same part. Each pair of input and part
    is tested in `CLEAR_TRIALS` trials without a known influence on the part.

    Attributes:
        influences: (N, P) bool, the influences found so far.
    """

    def __init__(self, nearby: np.ndarray, kinds: np.ndarray, trial_count: int):
        """Prepare the tests.

        Args:
            nearby: (N, P) bool, inputs that are likely to influence each part; N and P are at least 1.
            kinds: (N,), inputs of different kinds are never in one group.
            trial_count: T, at least 1.
        """
        self.influences = np.zeros_like(nearby)
        self._nearby, self._kinds = nearby, kinds
        self._second_nearby = _count_shared_parts(nearby, nearby) @ nearby > 0
        # Each group of an input changed the part, in this trial.
        self._candidates = np.ones((trial_count, *nearby.shape), bool)
        # A group of an input did not change the part, but each changed it by more than `MIN_MARGINAL_CHANGE`.
        self._marginal = np.zeros_like(self._candidates)
        self._unexplained: list[_Answer] = []
        self._separation_counts = [0] * trial_count
        # A fixed seed: each run finds the same influences.
        self._rng = np.random.default_rng(0)

    def divide_inputs(self) -> list[np.ndarray]:
        """Divide all inputs into groups, arrays of indices; each call returns another random division."""
        input_count, group_count = len(self._nearby), round(GROUPS_PER_INFLUENCE * self._nearby.sum(axis=0).mean())
        if input_count <= 2 * group_count:
            # Small groups save less than the tests to attribute their answers cost.
            return [np.array([index]) for index in range(input_count)]
        conflicts = _count_shared_parts(self._nearby, self._nearby)
        conflicts += SECOND_NEARBY_WEIGHT * _count_shared_parts(self._second_nearby, self._second_nearby)
        return self._color(np.ones(input_count, bool), conflicts, group_count)

    def add_changes(self, trial: int, groups: list[np.ndarray], changes: np.ndarray) -> None:
        """Add what groups of a trial changed: (G, P) float, change of each part relative to the threshold."""
        for group, part_changes in zip(groups, changes, strict=True):
            parts, candidates = part_changes > 1, self._candidates[trial][group]
            # Small changes may add up in a group, so the last candidate is a cause only after a test without others. A
            # marginal member may be the cause, although it was ruled out.
            is_clear = candidates.sum(axis=0) + self._marginal[trial][group].sum(axis=0) == 1
            self.influences[group] |= candidates & parts & is_clear
            possible = (candidates | self._marginal[trial][group]) & (part_changes > MIN_MARGINAL_CHANGE)
            self._candidates[trial][group] = candidates & parts
            self._marginal[trial][group] = possible & ~(candidates & parts)
            self._unexplained.append(_Answer(trial, group, parts))

    def next_groups(self) -> tuple[int, list[np.ndarray]] | None:
        """Attribute the answers, and return a trial and groups to test in it; None when nothing is left to test.

        First the most likely cause of each answer is tested; if that is not the cause, the group is split.
        """
        self._unexplained = [answer for answer in self._unexplained if self._suspects(answer).any()]
        open_counts = np.zeros(len(self._candidates), int)
        for answer in self._unexplained:
            open_counts[answer.trial] += self._suspects(answer).any(axis=0).sum()
        trial = int(open_counts.argmax())
        if not open_counts[trial]:
            return self._next_groups_of_hidden()
        self._separation_counts[trial] += 1
        suspects, likely_causes = np.zeros_like(self._nearby), np.zeros_like(self._nearby)
        scores = (
            self._candidates.sum(axis=0) + self._nearby + self._second_nearby + self._rng.random(self._nearby.shape)
        )
        for answer in self._unexplained:
            if answer.trial == trial:
                suspects_in_group = self._suspects(answer)
                suspects[answer.group] |= suspects_in_group
                ranks = np.where(suspects_in_group, scores[answer.group], 0)
                likely_causes[answer.group] |= suspects_in_group & (ranks == ranks.max(axis=0))
        if self._separation_counts[trial] % 2:
            return trial, self._separate(trial, likely_causes, 1, likely_causes)
        return trial, self._separate(trial, suspects, SPLIT_GROUPS)

    def _next_groups_of_hidden(self) -> tuple[int, list[np.ndarray]] | None:
        """Return groups for inputs that known influences hide in too many trials; None without such inputs."""
        trial_count = len(self._candidates)
        hidden = self._candidates.sum(axis=0) > trial_count - min(CLEAR_TRIALS, trial_count)
        hidden_in_trials = self._candidates & hidden & ~self.influences
        trial = int(hidden_in_trials.sum(axis=(1, 2)).argmax())
        if not hidden_in_trials[trial].any():
            return None
        return trial, self._separate(trial, hidden_in_trials[trial], SPLIT_GROUPS)

    def _suspects(self, answer: _Answer) -> np.ndarray:
        """Return (G, P) bool: members of a group that may have changed a part that no known influence has changed."""
        candidates = self._candidates[answer.trial][answer.group]
        return candidates & answer.parts & ~(candidates & self.influences[answer.group]).any(axis=0)

    def _separate(
        self, trial: int, tested: np.ndarray, group_count: int, apart: np.ndarray | None = None
    ) -> list[np.ndarray]:
        """Divide the inputs of (N, P) tested pairs into groups without influences on the parts of the pairs.

        Args:
            trial: the trial of the groups, whose marginal inputs are kept apart, too.
            tested: (N, P) bool.
            group_count: smallest number of groups.
            apart: (N, P) bool, more inputs that are not in one group with a tested input of the same part.
        """
        others = self.influences | self._marginal[trial]
        if apart is not None:
            others |= apart
        conflicts = _count_shared_parts(tested, others)
        return self._color(tested.any(axis=1), conflicts + conflicts.T, group_count, is_strict=True)

    def _color(
        self, is_member: np.ndarray, conflicts: np.ndarray, group_count: int, is_strict: bool = False
    ) -> list[np.ndarray]:
        """Divide members into groups with few conflicts, greedily: those with many conflicts first.

        Args:
            is_member: (N,) bool.
            conflicts: (N, N) float32, weight of the conflict between two inputs, 0 without a conflict.
            group_count: number of groups for each kind of inputs.
            is_strict: add groups until no two members of a group are in conflict.
        """
        colored = []
        for kind in np.unique(self._kinds[is_member]):
            members = self._rng.permutation(np.flatnonzero(is_member & (self._kinds == kind)))
            conflict_counts = (conflicts[np.ix_(members, members)] > 0).sum(axis=1)
            groups: list[list[int]] = [[] for _ in range(min(max(group_count, 1), len(members)))]
            weights = np.zeros((len(members), len(conflicts)), np.float32)
            for member in members[np.argsort(-conflict_counts, kind="stable")].tolist():
                member_weights = weights[: len(groups), member]
                if is_strict and member_weights.min() > 0:
                    groups.append([])
                    member_weights = weights[: len(groups), member]
                free = np.flatnonzero(member_weights == member_weights.min()).tolist()
                smallest_size = min(len(groups[index]) for index in free)
                index = self._rng.choice([index for index in free if len(groups[index]) == smallest_size])
                groups[index].append(member)
                weights[index] += conflicts[member]
            colored += [np.sort(group) for group in groups if group]
        return colored


def _count_shared_parts(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return (N, N) float32: the number of parts that inputs of two (N, P) bool arrays share."""
    return first.astype(np.float32) @ second.T.astype(np.float32)
