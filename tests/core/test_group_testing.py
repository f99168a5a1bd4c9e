# SPDX-License-Identifier: GPL-3.0-or-later
"""Group testing finds the same influences as testing one input after the other, in fewer tests."""

from collections.abc import Callable

import numpy as np
import pytest

from fdda_addon.core.group_testing import GroupTesting
from fdda_addon.core.patches import Patches

VERTICES_PER_PATCH = 4
Changes = Callable[[int, np.ndarray], np.ndarray]
"""Changes of (Q,) patches, or (Q, 4, 3) of their vertices, by a group of inputs in a trial."""


def find_influences(
    nearby: np.ndarray, kinds: np.ndarray, trials: int, change_of: Changes, patches_per_partition: int = 1
) -> tuple[np.ndarray, int]:
    """Return the influences and the number of tests, and check the groups."""
    patch_count = nearby.shape[1]
    starts = np.arange(patch_count) * VERTICES_PER_PATCH
    vertices = np.random.default_rng(0).permutation(patch_count * VERTICES_PER_PATCH)
    patches = Patches(vertices, starts, np.arange(0, patch_count, patches_per_partition))
    testing, test_count = GroupTesting(nearby, kinds, patches), 0
    for trial in range(trials):
        testing.start_trial()
        divided: list[list[int]] = []
        while groups := testing.next_groups():
            test_count += len(groups)
            divided.append(np.concatenate(groups).tolist())
            assert len(divided[-1]) == len(set(divided[-1]))
            assert all(len(np.unique(kinds[group])) == 1 for group in groups)
            changes = np.zeros((len(groups), patch_count, VERTICES_PER_PATCH, 3), np.float32)
            for index, group in enumerate(groups):
                change = change_of(trial, group)
                changes[index] = change if change.ndim == 3 else change[:, None, None] * [1, 0, 0]
            testing.add_changes(groups, changes.reshape(len(groups), -1, 3))
        assert sorted(divided[0]) == list(range(len(nearby)))
    return testing.influences, test_count


def vector_changes(rng: np.random.Generator, sizes: np.ndarray) -> np.ndarray:
    """Return random changes of the vertices of patches, (..., 4, 3), whose largest norms are (...) sizes."""
    changes = rng.normal(size=(*sizes.shape, VERTICES_PER_PATCH, 3))
    return changes * (sizes / np.linalg.norm(changes, axis=-1).max(axis=-1))[..., None, None]


@pytest.mark.parametrize("seed", range(60))
def test_the_influences_are_those_of_single_inputs(seed):
    """Whatever part of the true influences, and of the others, the caller takes for likely."""
    rng = np.random.default_rng(seed)
    inputs, patches, trials = rng.integers(1, [121, 41, 4]).tolist()
    truth = rng.random((inputs, patches)) < rng.integers(9) / inputs
    nearby = rng.random(truth.shape) < np.where(truth, rng.random(), 0.05)
    kinds = np.where(rng.random(inputs) < 0.8, "joint", "control")
    changes = vector_changes(rng, truth * rng.uniform(2, 50, (trials, *truth.shape)))
    found, _ = find_influences(nearby, kinds, trials, lambda trial, group: changes[trial][group].sum(axis=0))
    assert not (truth & ~found).any()
    assert (found & ~truth).sum() <= 2


@pytest.mark.parametrize("seed", range(20))
def test_an_influence_of_one_trial_is_found(seed):
    """Each patch has one influence, which acts in one trial only."""
    rng = np.random.default_rng(seed)
    inputs, patches, trials = rng.integers([2, 1, 1], [81, 11, 4]).tolist()
    causes, acting_trials = rng.integers(inputs, size=patches), rng.integers(trials, size=patches)
    truth = np.zeros((inputs, patches), bool)
    truth[causes, np.arange(patches)] = True
    sizes = 2.0 * truth * (acting_trials == np.arange(trials)[:, None])[:, None]
    changes = vector_changes(rng, sizes)
    found, _ = find_influences(
        np.zeros_like(truth), np.zeros(inputs), trials, lambda trial, group: changes[trial][group].sum(axis=0)
    )
    assert np.array_equal(found, truth)


@pytest.mark.parametrize("change", [0.02, 0.05, 0.1, 0.2])
def test_small_equal_changes_that_add_up_are_no_influence(change):
    """Each input moves the patch in one direction by less than the threshold of 1, and a group of them by more."""
    nearby = np.zeros((60, 1), bool)
    found, _ = find_influences(nearby, np.zeros(60), 3, lambda _, group: np.full(1, change * len(group)))
    assert not found.any()


@pytest.mark.parametrize("change", [0.1, 0.2, 0.3, 0.4])
def test_small_changes_that_add_up_are_no_influence(change):
    """Each input changes the patch by less than the threshold of 1, and a group of them by more."""
    changes = vector_changes(np.random.default_rng(0), np.full((60, 1), change))
    nearby = np.zeros((60, 1), bool)
    found, _ = find_influences(nearby, np.zeros(60), 3, lambda _, group: changes[group].sum(axis=0))
    assert not found.any()


@pytest.mark.parametrize("seed", range(4))
def test_changes_near_the_threshold_blame_no_other_input(seed):
    """Most true changes are near the threshold of 1, and those of a group add up or cancel each other."""
    rng = np.random.default_rng(seed)
    truth = rng.random((200, 100)) < 0.02
    sizes = truth * np.abs(rng.normal(0, 1.2, (4, *truth.shape)))
    changes = vector_changes(rng, sizes)
    found, _ = find_influences(truth, np.zeros(200), 4, lambda trial, group: changes[trial][group].sum(axis=0))
    assert found[sizes.max(axis=0) < 0.5].sum() <= 3
    assert found[sizes.max(axis=0) > 1].mean() > 0.98


@pytest.mark.parametrize("seed", range(4))
def test_influences_are_found_although_changes_add_up_only_nearly(seed):
    """Two inputs in a group change what the other one does by a fiftieth of the smaller change."""
    rng = np.random.default_rng(seed)
    truth = rng.random((300, 60)) < 0.03
    changes = vector_changes(rng, truth * np.exp(rng.uniform(1, 6, (2, *truth.shape))))

    def change_of(trial: int, group: np.ndarray) -> np.ndarray:
        of_members = changes[trial][group]
        norms = np.sort(np.linalg.norm(of_members, axis=-1).max(axis=-1), axis=0)
        interaction = 0.02 * norms[-2] if len(group) > 1 else np.zeros(truth.shape[1])
        return of_members.sum(axis=0) + vector_changes(rng, interaction)

    found, _ = find_influences(truth & (rng.random(truth.shape) < 0.5), np.zeros(300), 2, change_of)
    assert (truth & ~found).sum() <= 0.01 * truth.sum()
    assert (found & ~truth).sum() <= 0.03 * truth.sum()


def test_influences_are_found_where_every_second_input_acts_on_a_patch():
    rng = np.random.default_rng(0)
    sizes = np.zeros((2, 60, 10))
    sizes[1] = 2 * (rng.random((60, 10)) < 0.5)
    changes = vector_changes(rng, sizes)
    nearby = np.zeros((60, 10), bool)
    found, _ = find_influences(nearby, np.zeros(60), 2, lambda trial, group: changes[trial][group].sum(axis=0))
    assert not (~found & (sizes[1] > 0)).any()


@pytest.mark.parametrize(("inputs", "most_tests"), [(100, 35), (800, 95)])
def test_the_number_of_tests_hardly_grows_with_the_number_of_inputs(inputs, most_tests):
    """A chain, in which each part follows two neighbors on each side, and one of them is not known to be likely."""
    distance = np.abs(np.arange(inputs)[:, None] - np.arange(inputs))
    truth, nearby = distance <= 2, distance <= 1
    changes = vector_changes(np.random.default_rng(0), 2.0 * truth)
    found, test_count = find_influences(nearby, np.zeros(inputs), 1, lambda _, group: changes[group].sum(axis=0))
    assert np.array_equal(found, truth)
    assert test_count <= most_tests


def first_of_group(changes: np.ndarray) -> np.ndarray:
    """Return the change of each patch by the first member that changes it, (Q, 4, 3): a driver that switches."""
    first = (np.abs(changes).max(axis=(-2, -1)) > 0).argmax(axis=0)
    return changes[first, np.arange(changes.shape[1])]


def largest_of_group(changes: np.ndarray) -> np.ndarray:
    """Return the largest change of each patch, (Q, 4, 3): a driver that takes a maximum."""
    largest = np.linalg.norm(changes, axis=-1).max(axis=-1).argmax(axis=0)
    return changes[largest, np.arange(changes.shape[1])]


def limited_sum_of_group(changes: np.ndarray) -> np.ndarray:
    """Return changes that add up to at most 20: Shrinkwrap, or a shape key with a largest value."""
    total = changes.sum(axis=0)
    lengths = np.linalg.norm(total, axis=-1, keepdims=True)
    return total * 20 * np.tanh(lengths / 20) / np.maximum(lengths, 1e-9)


@pytest.mark.parametrize("change_of_group", [first_of_group, largest_of_group, limited_sum_of_group])
@pytest.mark.parametrize("inputs", [60, 200])
def test_influences_are_found_although_inputs_hide_each_other(inputs, change_of_group):
    missed, needless, tests = 0, 0, 0
    for seed in range(2):
        rng = np.random.default_rng(seed)
        truth = rng.random((inputs, 60)) < 5 / inputs
        sizes = truth * np.exp(rng.uniform(1, 5, (4, *truth.shape)))
        changes, nearby = vector_changes(rng, sizes), truth & (rng.random(truth.shape) < 0.5)
        found, test_count = find_influences(
            nearby, np.zeros(inputs), 4, lambda trial, group, changes=changes: change_of_group(changes[trial][group])
        )
        missed, needless, tests = missed + (truth & ~found).sum(), needless + (found & ~truth).sum(), tests + test_count
    assert missed <= 1
    assert needless <= 4
    assert tests < 2 * 4 * inputs


def test_influences_of_inputs_that_change_patches_equally_are_found():
    """Two bones of the same range drive one shape key: their changes are equal, and differ from trial to trial."""
    missed = 0
    for seed in range(2):
        rng = np.random.default_rng(seed)
        truth = np.repeat(rng.random((60, 60)) < 0.03, 2, axis=0)
        changes = vector_changes(rng, truth * np.exp(rng.uniform(1, 5, (4, *truth.shape))))
        changes[:, 1::2] = changes[:, ::2]
        nearby = truth & (rng.random(truth.shape) < 0.5)
        found, _ = find_influences(
            nearby, np.zeros(120), 4, lambda trial, group, changes=changes: changes[trial][group].sum(axis=0)
        )
        missed += (truth & ~found).sum()
    assert missed <= 1


def test_influences_are_found_where_every_input_acts_on_every_patch():
    rng = np.random.default_rng(0)
    changes = vector_changes(rng, np.exp(rng.uniform(1, 5, (4, 60, 40))))
    nearby = rng.random((60, 40)) < 0.05
    found, _ = find_influences(nearby, np.zeros(60), 4, lambda trial, group: changes[trial][group].sum(axis=0))
    assert found.all()


@pytest.mark.parametrize("changes", [0.5, 2.0])
@pytest.mark.parametrize("inputs", [1, 2])
def test_one_or_two_inputs_are_tested_alone(inputs, changes):
    found, tests = find_influences(
        np.zeros((inputs, 1), bool), np.zeros(inputs), 4, lambda _, group: np.full(1, changes * len(group))
    )
    assert found.all() == (changes > 1) == found.any()
    assert tests == (4 * inputs)
