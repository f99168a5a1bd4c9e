# SPDX-License-Identifier: GPL-3.0-or-later
"""Group testing: finds which inputs influence which parts, by changing several inputs at the same time.

In each trial, all inputs are divided into groups twice. Inputs that probably act on the same patch are in different
groups, and no two inputs are together twice. The number of groups is the largest number of inputs that probably act on
one patch: it grows with the depth of the graph of shared patches, and at least with the square root of the number of
inputs. Then `core.change_decoder` attributes the changes, and undecided inputs are divided again. Inputs whose
effects others hide are tested alone in the end. What a trial has found makes the divisions of the next trial better.
"""

import math

import numpy as np

from .change_decoder import ChangeDecoder
from .patches import Patches

NEAR_PROBABILITY, SECOND_NEAR_PROBABILITY, FAR_PROBABILITY = 0.7, 0.1, 0.003
"""Probability that an input acts on a patch, before any trial: it is near the patch, it is near another patch that
shares a nearby input with it, or neither. Measured on five characters."""
GROUPS_PER_ROOT = 1.5
"""Smallest number of groups, as a ratio of the square root of the number of inputs. Fewer groups could not be divided
again without two inputs together twice."""
MAX_INPUTS_PER_GROUP = 4
"""With fewer inputs per group, testing each alone costs no more than two divisions and their remainder."""
DIVISIONS, MIN_DIVISIONS, MAX_DIVISIONS = 2, 3, 8
"""Number of divisions of all inputs in a trial, and numbers with those of undecided inputs."""
MIN_TESTS = 64
"""Undecided inputs are divided more often than `MIN_DIVISIONS` until the trial has had this number of tests."""
MIN_UNDECIDED_PROBABILITY = 0.3
"""Smallest probability of an undecided pair of input and patch in the third division: two groups of the input changed
the patch. It grows with each further division, until inputs are tested alone where every input acts."""
MAX_TESTS_ALONE = 64
"""Largest number of inputs that are tested alone at the end of a trial, because others may have hidden them. It is all
inputs of most rigs, and limits the time for rigs of hundreds."""
ACTING_CONFLICT = 0.05
"""Weight of a conflict with an input that is known to act. Its change is subtracted, but nearly only."""
TOGETHER_CONFLICT = 100.0
"""Weight of a conflict between inputs that were together in a group before."""


class GroupTesting:
    """Finds the influences of N inputs on P partitions, trial by trial.

    In a trial each input changes from the same state to the same value, in every group.

    Attributes:
        influences: (N, P) bool, the influences found so far.
    """

    def __init__(self, nearby: np.ndarray, kinds: np.ndarray, patches: Patches):
        """Prepare the tests.

        Args:
            nearby: (N, Q) bool, inputs that are likely to influence each patch; N and Q are at least 1.
            kinds: (N,), inputs of different kinds are never in one group.
            patches: Q patches in P partitions.
        """
        self._kinds, self._patches = kinds, patches
        near = nearby.astype(np.float32)
        is_second_near = (near @ near.T) @ near > 0
        self._prior = np.where(
            nearby, NEAR_PROBABILITY, np.where(is_second_near, SECOND_NEAR_PROBABILITY, FAR_PROBABILITY)
        ).astype(np.float32)
        self._acting_counts, self._decided_counts = np.zeros_like(self._prior), np.zeros_like(self._prior)
        self.influences = patches.any_of_partition(np.zeros_like(nearby))
        # A fixed seed: each run finds the same influences.
        self._rng = np.random.default_rng(0)
        self.start_trial()

    def start_trial(self) -> None:
        """Start a trial, in which the base pose and the values of all inputs are others."""
        self._decoder = ChangeDecoder(len(self._prior), self._patches)
        self._division_count = self._test_count = 0
        self._may_suspect = True

    @property
    def _probabilities(self) -> np.ndarray:
        """(N, Q) float32, probability that an input acts on a patch in a trial: the prior counts as one trial."""
        return (self._acting_counts + self._prior) / (self._decided_counts + 1)

    def next_groups(self) -> list[np.ndarray]:
        """Return groups to test in this trial, arrays of indices of inputs; none when the trial is complete."""
        undecided = self._decoder.undecided
        if self._division_count >= DIVISIONS:
            # Where an input has been found to influence a partition, other patches of the partition do not matter.
            found = self.influences | self._patches.any_of_partition(self._decoder.acts)
            undecided = undecided & ~found[:, self._patches.partition_of_patch]
        is_member = undecided.any(axis=1)
        is_long = self._division_count >= MIN_DIVISIONS and self._test_count >= MIN_TESTS
        if not is_member.any() or is_long or self._division_count == MAX_DIVISIONS:
            suspects = self._suspects() if self._may_suspect else []
            self._may_suspect = False
            if not len(suspects):
                self._complete_trial()
            return [np.array([index]) for index in suspects]
        self._division_count += 1
        if self._division_count <= DIVISIONS:
            likely = self._probabilities
            group_count = max(likely.sum(axis=0).max(), GROUPS_PER_ROOT * math.sqrt(len(likely)))
            return self._color(is_member, likely @ likely.T, math.ceil(group_count))
        min_probability = min(1.0, MIN_UNDECIDED_PROBABILITY * (self._division_count - DIVISIONS))
        likely = np.where(undecided, np.maximum(self._probabilities, min_probability), 0)
        conflicts = likely @ np.where(self._decoder.acts, ACTING_CONFLICT, likely).T
        return self._color(is_member, conflicts + conflicts.T, math.ceil(max(likely.sum(axis=0).max(), 2)))

    def _suspects(self) -> np.ndarray:
        """Return inputs to test alone, because changes contradict what was decided: the largest changes first."""
        found = self.influences | self._patches.any_of_partition(self._decoder.acts)
        changes = np.where(found[:, self._patches.partition_of_patch], 0, self._decoder.contradictions()).max(axis=1)
        suspects = np.argsort(-changes, kind="stable")[:MAX_TESTS_ALONE]
        return suspects[changes[suspects] > 0]

    def add_changes(self, groups: list[np.ndarray], changes: np.ndarray) -> None:
        """Add the changes that groups cause: (G, V, 3) float32 as of `Patches.sort`, relative to the threshold."""
        self._test_count += len(groups)
        self._decoder.add(groups, changes)
        self._decoder.decode(self._probabilities)

    def _complete_trial(self) -> None:
        """Keep the results of the trial. The most likely causes of unexplained changes count as influences."""
        decoder = self._decoder
        causes = decoder.acts | decoder.likely_causes(self._probabilities)
        self.influences |= self._patches.any_of_partition(causes)
        self._acting_counts += decoder.acts
        self._decided_counts += ~decoder.undecided

    def _color(self, is_member: np.ndarray, conflicts: np.ndarray, group_count: int) -> list[np.ndarray]:
        """Divide members into groups with few conflicts, greedily: those with the largest conflicts first.

        Args:
            is_member: (N,) bool.
            conflicts: (N, N) float32, weight of the conflict between two inputs.
            group_count: number of groups for each kind of inputs.
        """
        together = TOGETHER_CONFLICT * self._decoder.share_group()
        colored: list[np.ndarray] = []
        for kind in np.unique(self._kinds[is_member]):
            members = np.flatnonzero(is_member & (self._kinds == kind))
            if self._division_count == 1 and len(members) <= MAX_INPUTS_PER_GROUP * group_count:
                colored += list(members[:, None])
                continue
            ranks = conflicts[np.ix_(members, members)].sum(axis=1)
            groups: list[list[int]] = [[] for _ in range(min(group_count, len(members)))]
            weights = np.zeros((len(groups), len(conflicts)), np.float32)
            noise = self._rng.random((len(members), len(groups)))
            for number in np.argsort(-ranks, kind="stable").tolist():
                member = int(members[number])
                sizes = np.array([len(group) for group in groups])
                index = int(np.argmin(weights[:, member] + 1e-4 * sizes + 1e-5 * noise[number]))
                groups[index].append(member)
                weights[index] += conflicts[member] + together[member]
            colored += [np.sort(group) for group in groups if group]
        return colored
