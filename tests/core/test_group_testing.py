# SPDX-License-Identifier: GPL-3.0-or-later
"""Group testing finds the same influences as testing one input after the other, in fewer tests."""

from collections.abc import Callable

import numpy as np
import pytest

from fdda_addon.core.group_testing import GroupTesting

Changes = Callable[[int, np.ndarray], np.ndarray]


def find_influences(nearby: np.ndarray, kinds: np.ndarray, trials: int, change_of: Changes) -> tuple[np.ndarray, int]:
    """Return the influences and the number of tests, and check that no group mixes kinds."""
    testing, test_count = GroupTesting(nearby, kinds, trials), 0

    def test(trial: int, groups: list[np.ndarray]) -> None:
        nonlocal test_count
        test_count += len(groups)
        assert all(len(np.unique(kinds[group])) == 1 for group in groups)
        testing.add_changes(trial, groups, np.array([change_of(trial, group) for group in groups], np.float32))

    for trial in range(trials):
        groups = testing.divide_inputs()
        assert sorted(np.concatenate(groups).tolist()) == list(range(len(nearby)))
        test(trial, groups)
    while (next_test := testing.next_groups()) is not None:
        test(*next_test)
    return testing.influences, test_count


@pytest.mark.parametrize("seed", range(60))
def test_the_influences_are_those_of_single_inputs(seed):
    """Whatever part of the true influences, and of the others, the caller takes for likely."""
    rng = np.random.default_rng(seed)
    inputs, parts, trials = rng.integers(1, [61, 41, 5]).tolist()
    truth = rng.random((inputs, parts)) < rng.integers(9) / inputs
    nearby = rng.random(truth.shape) < np.where(truth, rng.random(), 0.05)
    kinds = np.where(rng.random(inputs) < 0.8, "joint", "control")
    found, _ = find_influences(nearby, kinds, trials, lambda _, group: 2.0 * truth[group].any(axis=0))
    assert np.array_equal(found, truth)


@pytest.mark.parametrize("seed", range(20))
def test_an_influence_of_one_trial_is_found(seed):
    """Each part has one influence, which acts in one trial only."""
    rng = np.random.default_rng(seed)
    inputs, parts, trials = rng.integers([2, 1, 1], [41, 11, 4]).tolist()
    causes, acting_trials = rng.integers(inputs, size=parts), rng.integers(trials, size=parts)
    truth = np.zeros((inputs, parts), bool)
    truth[causes, np.arange(parts)] = True
    found, _ = find_influences(
        np.zeros_like(truth),
        np.zeros(inputs),
        trials,
        lambda trial, group: 2.0 * (truth[group].any(axis=0) & (acting_trials == trial)),
    )
    assert np.array_equal(found, truth)


@pytest.mark.parametrize("change", [0.02, 0.05, 0.1, 0.2])
def test_small_changes_that_add_up_are_no_influence(change):
    """Each input changes the part by less than the threshold of 1, and a group of them by more."""
    changes = np.full((60, 1), change)
    found, _ = find_influences(np.zeros((60, 1), bool), np.zeros(60), 3, lambda _, group: changes[group].sum(axis=0))
    assert not found.any()


@pytest.mark.parametrize("seed", range(4))
def test_changes_near_the_threshold_blame_no_other_input(seed):
    """Most true changes are near the threshold of 1, and those of a group add up or cancel each other."""
    rng = np.random.default_rng(seed)
    truth = rng.random((200, 100)) < 0.02
    changes = truth * rng.normal(0, 1.2, (4, *truth.shape))
    found, _ = find_influences(truth, np.zeros(200), 4, lambda trial, group: np.abs(changes[trial][group].sum(axis=0)))
    largest = np.abs(changes).max(axis=0)
    assert found[largest < 0.5].sum() <= 3
    assert found[largest > 1].mean() > 0.94


def test_an_influence_is_found_that_is_hidden_in_the_only_pose_in_which_it_acts():
    """In the second trial, all inputs but the last ones change all parts; the first trial has no influence."""
    rng = np.random.default_rng(0)
    changes = np.zeros((2, 60, 10))
    changes[1] = 2 * (rng.random((60, 10)) < 0.5)
    found, _ = find_influences(
        np.zeros((60, 10), bool), np.zeros(60), 2, lambda trial, group: changes[trial][group].max(axis=0)
    )
    assert np.array_equal(found, changes[1] > 0)


@pytest.mark.parametrize(("inputs", "most_tests"), [(100, 80), (800, 115)])
def test_the_number_of_tests_hardly_grows_with_the_number_of_inputs(inputs, most_tests):
    """A chain, in which each part follows two neighbors on each side, and one of them is not known to be likely."""
    distance = np.abs(np.arange(inputs)[:, None] - np.arange(inputs))
    truth, nearby = distance <= 2, distance <= 1
    found, test_count = find_influences(nearby, np.zeros(inputs), 1, lambda _, group: 2.0 * truth[group].any(axis=0))
    assert np.array_equal(found, truth)
    assert test_count <= most_tests
