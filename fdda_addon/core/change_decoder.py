# SPDX-License-Identifier: GPL-3.0-or-later
"""Attributes the changes that groups of inputs cause to single inputs, as peeling decoders of sparse signals do.

The changes of the inputs of a group add up, nearly. Two groups that share one input and change a patch equally have
this input as their only cause. Its change is subtracted from all groups, which uncovers the next cause (compare
Goodrich and Mitzenmacher, 2011).
"""

from itertools import combinations

import numpy as np

from .patches import Patches, largest_norms

MAX_RELATIVE_DIFFERENCE, MAX_DIFFERENCE = 0.15, 0.2
"""Two changes are equal if they differ by at most a ratio of the smaller one, plus a ratio of the threshold. Changes
add up only nearly, and changes below the threshold are in every group."""
LIKELIHOOD_RATIO = 50.0
"""Equal changes make their common input more likely by this factor, relative to two inputs with similar changes."""
MIN_PROBABILITY = 1e-3
"""Smallest probability in the comparison of two explanations, because probabilities are estimates."""
MIN_CONTRADICTION = 2.0
"""Smallest unexplained change that contradicts decisions, relative to the threshold, because small changes add up."""
MAX_SUSPECTS = 4
"""Largest number of suspects for one unexplained change. Where many inputs act on a patch, there are always some."""


class ChangeDecoder:
    """Finds which of N inputs act on which of Q patches, from changes that groups of inputs cause in one trial.

    Attributes:
        acts: (N, Q) bool, inputs that change a patch.
        ruled_out: (N, Q) bool, inputs that do not change a patch. The other inputs are undecided.
    """

    def __init__(self, input_count: int, patches: Patches):
        self.acts = np.zeros((input_count, len(patches.starts)), bool)
        self.ruled_out = np.zeros_like(self.acts)
        self._patches = patches
        self._members = np.zeros((0, input_count), bool)
        self._changes = np.zeros((0, len(patches.vertices), 3), np.float32)
        # Largest norms of the changes of each group, before and after known changes are subtracted.
        self._original_norms = np.zeros((0, len(patches.starts)), np.float32)
        self._norms = self._original_norms
        # By input: indices of vertices, and their changes by this input.
        self._changes_of_inputs: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}

    @property
    def undecided(self) -> np.ndarray:
        """(N, Q) bool, pairs of an input and a patch that no answer has decided."""
        return ~(self.acts | self.ruled_out)

    def share_group(self) -> np.ndarray:
        """Return (N, N) float32: the number of groups in which two inputs were together."""
        members = self._members.astype(np.float32)
        return members.T @ members

    def add(self, groups: list[np.ndarray], changes: np.ndarray) -> None:
        """Add groups, arrays of indices of inputs, and their changes: (G, V, 3) as of `Patches.sort`, per threshold."""
        members = np.zeros((len(groups), len(self.acts)), bool)
        self._original_norms = np.concatenate([self._original_norms, largest_norms(changes, self._patches.starts)])
        for is_member, group, change in zip(members, groups, changes, strict=True):
            is_member[group] = True
            for index in group.tolist():
                for vertices, input_change in self._changes_of_inputs.get(index, ()):
                    change[vertices] -= input_change
        for group, norms in zip(groups, self._original_norms[-len(groups) :], strict=True):
            if len(group) == 1:
                self.acts[group[0]], self.ruled_out[group[0]] = norms > 1, norms <= 1
        self._members = np.concatenate([self._members, members])
        self._changes = np.concatenate([self._changes, changes])
        self._norms = np.concatenate([self._norms, largest_norms(changes, self._patches.starts)])

    def decode(self, probabilities: np.ndarray) -> None:
        """Attribute changes to inputs until no further change has a single cause.

        Args:
            probabilities: (N, Q), probability that an input acts on a patch, before the changes are known.
        """
        is_progress = True
        while is_progress:
            acting_count = self.acts.sum()
            for index in np.flatnonzero(self.undecided.any(axis=1)).tolist():
                self._decide(index, probabilities)
            is_progress = self.acts.sum() > acting_count

    def likely_causes(self, probabilities: np.ndarray) -> np.ndarray:
        """Return (N, Q) bool: undecided inputs that are at least half as likely as any other cause of some change.

        A small part of what a group changed needs no other cause, because changes add up only nearly.
        """
        causes = np.zeros_like(self.acts)
        is_unexplained = self._is_unexplained(1)
        for members, is_group_unexplained in zip(self._members, is_unexplained, strict=True):
            suspects = np.where(self.undecided[members] & is_group_unexplained, probabilities[members], 0)
            causes[members] |= (suspects > 0) & (suspects >= suspects.max(axis=0) / 2)
        return causes

    def contradictions(self) -> np.ndarray:
        """Return (N, Q) float32: unexplained changes, at inputs that may cause them although they were ruled out.

        All inputs of such a group are decided, and known causes leave more than a small part of its change. Another
        input has hidden the cause in another group, as a driver that switches does: all its groups changed the patch.

        Returns:
            The largest change relative to the threshold; 0 where nothing contradicts.
        """
        contradictions = np.zeros(self.acts.shape, np.float32)
        was_alone = self._members[self._members.sum(axis=1) == 1].any(axis=0)
        in_unchanged = self._members.T.astype(np.float32) @ (self._original_norms <= 1) > 0
        is_unexplained = self._is_unexplained(MIN_CONTRADICTION)
        for members, is_group_unexplained, norms in zip(self._members, is_unexplained, self._norms, strict=True):
            patches = np.flatnonzero(is_group_unexplained & ~self.undecided[members].any(axis=0))
            inputs = np.flatnonzero(members & ~was_alone)
            selection = np.ix_(inputs, patches)
            is_hidden = self.ruled_out[selection] & ~in_unchanged[selection]
            is_hidden &= is_hidden.sum(axis=0) <= MAX_SUSPECTS
            contradictions[selection] = np.maximum(contradictions[selection], is_hidden * norms[patches])
        return contradictions

    def _is_unexplained(self, min_change: float) -> np.ndarray:
        """Return (G, Q) bool: changes of groups of which known causes leave more than a small part."""
        return self._norms > np.maximum(min_change, MAX_RELATIVE_DIFFERENCE * self._original_norms)

    def _decide(self, index: int, probabilities: np.ndarray) -> None:
        """Decide on which patches an input acts, where its groups allow it."""
        groups = np.flatnonzero(self._members[:, index])
        self.ruled_out[index] |= ~self.acts[index] & (self._norms[groups] <= 1).any(axis=0)
        for pair in combinations(groups.tolist(), 2):
            possible = self.undecided[index] & (self._norms[list(pair)] > 1).all(axis=0)
            shared = self._members[list(pair)].all(axis=0)
            shared[index] = False
            possible &= ~self.undecided[shared].any(axis=0)
            patches = np.flatnonzero(possible)
            if not len(patches):
                continue
            vertices, starts = self._patches.select(patches)
            first, second = self._changes[np.ix_(pair, vertices)]
            differences = largest_norms(first - second, starts)
            smaller_norms = self._norms[np.ix_(pair, patches)].min(axis=0)
            is_cause = differences <= MAX_RELATIVE_DIFFERENCE * smaller_norms + MAX_DIFFERENCE
            is_cause &= self._is_likely_cause(index, pair, patches, probabilities)
            if is_cause.any():
                self._subtract(index, groups, pair, patches[is_cause])

    def _is_likely_cause(
        self, index: int, pair: tuple[int, int], patches: np.ndarray, probabilities: np.ndarray
    ) -> np.ndarray:
        """Return whether an input explains equal changes of two groups better than two others with similar changes."""
        alternative = np.ones(len(patches))
        for group in pair:
            others = np.flatnonzero(self._members[group])
            selection = np.ix_(others[others != index], patches)
            possible = np.where(self.undecided[selection], np.maximum(probabilities[selection], MIN_PROBABILITY), 0)
            alternative *= possible.max(axis=0, initial=0)
        return LIKELIHOOD_RATIO * np.maximum(probabilities[index, patches], MIN_PROBABILITY) > alternative

    def _subtract(self, index: int, groups: np.ndarray, pair: tuple[int, int], patches: np.ndarray) -> None:
        """Note that an input acts on patches, and subtract its changes from those of all its groups."""
        self.acts[index, patches] = True
        vertices, starts = self._patches.select(patches)
        first, second = self._changes[np.ix_(pair, vertices)]
        self._changes_of_inputs.setdefault(index, []).append((vertices, (first + second) / 2))
        for group in groups.tolist():
            # Subtract the change of the other group, so that the difference of both remains.
            self._changes[group, vertices] -= second if group == pair[0] else first
        self._norms[np.ix_(groups, patches)] = largest_norms(self._changes[np.ix_(groups, vertices)], starts)
