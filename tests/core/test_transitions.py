# SPDX-License-Identifier: GPL-3.0-or-later
"""The table of a character's states: all pairs of state and event, and random walks, without Blender."""

import random
from dataclasses import dataclass

import pytest

from fdda_addon.runtime.transitions import SHOWS_MODEL, TABLE, Effect, Event, State, transition

ALL_PAIRS = [(state, event) for state in State for event in Event]
WALKS, WALK_LENGTH = 300, 200


@dataclass
class Scene:
    """What the effects change: a character as Blender shows it.

    Attributes:
        shows_model: whether the modifiers of the rig are off.
        has_player: whether a player exists.
        is_unchecked: whether the rig may have changed since the check.
        check_is_scheduled: whether a check will come.
        reports: number of reports to the user.
    """

    shows_model: bool = False
    has_player: bool = False
    is_unchecked: bool = False
    check_is_scheduled: bool = False
    reports: int = 0

    def apply(self, effect: Effect) -> None:
        """Apply an effect; assert that its conditions hold."""
        if effect == Effect.SHOW_MODEL:
            self.shows_model = True
        elif effect == Effect.SHOW_RIG:
            self.shows_model = False
        elif effect == Effect.CREATE_PLAYER:
            assert self.shows_model, "a player reads modifiers that show the model"
            assert not self.has_player, "the former player is still there"
            # A new player checks its rig.
            self.has_player, self.is_unchecked = True, False
        elif effect == Effect.REMOVE_PLAYER:
            self.has_player = self.is_unchecked = self.check_is_scheduled = False
        elif effect == Effect.SCHEDULE_CHECK:
            self.check_is_scheduled = True
        elif effect == Effect.CHECK_RIG:
            assert self.has_player
            self.is_unchecked = self.check_is_scheduled = False
        elif effect == Effect.REPORT:
            assert not self.shows_model, "the rig is shown before the reason is reported"
            self.reports += 1


class Walk:
    """A character that receives events."""

    def __init__(self) -> None:
        self.state, self.scene = State.UNBOUND, Scene()

    def dispatch(self, event: Event) -> None:
        """Apply the transition of an event, and assert what holds in the new state."""
        before, reports = self.state, self.scene.reports
        self.state, effects = transition(before, event)
        if event == Event.CHANGE and before in SHOWS_MODEL:
            self.scene.is_unchecked = True
        for effect in effects:
            self.scene.apply(effect)
        self.check(f"{before.name} and {event.name} lead to {self.state.name}")
        has_failed = self.state == State.FAILED and before != State.FAILED
        assert self.scene.reports - reports == has_failed, "each failure is reported once"

    def check(self, step: str) -> None:
        """Assert that the scene is as the state says."""
        scene, state = self.scene, self.state
        assert scene.shows_model == (state in SHOWS_MODEL), step
        assert scene.has_player == (state in SHOWS_MODEL), step
        if scene.is_unchecked:
            assert state == State.EDITED or (state == State.CHANGED and scene.check_is_scheduled), step


def reachable(state: State, events: frozenset[Event] = frozenset(Event)) -> set[State]:
    """Return the states that events lead to."""
    found, added = {state}, {state}
    while added:
        added = {transition(each, event).state for each in added for event in events} - found
        found |= added
    return found


@pytest.mark.parametrize(("state", "event"), ALL_PAIRS, ids=lambda value: value.name.lower())
def test_each_pair_leads_to_a_state_that_its_effects_prepare(state: State, event: Event):
    walk = walk_to(state)
    walk.dispatch(event)


def walk_to(state: State) -> Walk:
    """Return a character in a state, reached by events from the start."""
    paths: dict[State, list[Event]] = {State.UNBOUND: []}
    while state not in paths:
        for each, path in list(paths.items()):
            for event in Event:
                paths.setdefault(transition(each, event).state, [*path, event])
    walk = Walk()
    for event in paths[state]:
        walk.dispatch(event)
    assert walk.state == state
    return walk


def test_random_walks_keep_state_and_scene_together():
    for seed in range(WALKS):
        generator, walk = random.Random(seed), Walk()
        for _ in range(WALK_LENGTH):
            walk.dispatch(generator.choice(list(Event)))


def test_every_state_is_reachable_and_every_bound_character_can_play_again():
    assert reachable(State.UNBOUND) == set(State)
    for state in set(State) - {State.UNBOUND}:
        assert State.PLAYING in reachable(state), f"a character is frozen in {state.name}"
        assert State.UNBOUND in reachable(state)


def test_what_users_expect():
    """The mode decides, a written file shows rigs, and a failure stays until the user acts."""
    expected = {
        (State.BOUND, Event.CHOOSE_MODEL): State.PLAYING,
        (State.BOUND, Event.ANIMATE_MODEL): State.PLAYING,
        (State.BOUND, Event.RESUME): State.BOUND,
        (State.PLAYING, Event.SUSPEND): State.SUSPENDED,
        (State.EDITED, Event.SUSPEND): State.SUSPENDED,
        (State.SUSPENDED, Event.RESUME): State.PLAYING,
        (State.SUSPENDED, Event.CHOOSE_MODEL): State.SUSPENDED,
        (State.FAILED, Event.ANIMATE_MODEL): State.FAILED,
        (State.FAILED, Event.RESUME): State.FAILED,
        (State.FAILED, Event.CHECK): State.FAILED,
        (State.FAILED, Event.CHOOSE_MODEL): State.PLAYING,
    }
    for state in SHOWS_MODEL:
        expected[state, Event.SHOW_RIG] = State.BOUND
        expected[state, Event.FAIL] = State.FAILED
    assert {pair: transition(*pair).state for pair in expected} == expected


def test_a_changed_or_edited_rig_is_checked_before_the_model_counts_as_checked():
    for state in (State.CHANGED, State.EDITED):
        for event in Event:
            following, effects = transition(state, event)
            if following == State.PLAYING:
                assert Effect.CHECK_RIG in effects or Effect.CREATE_PLAYER in effects, event
    assert Effect.FORGET_CHECK in transition(State.EDITED, Event.LEAVE_EDIT).effects, "edited weights are read again"


def test_the_table_names_no_transition_that_does_nothing():
    idle = {
        (state.name, event.name)
        for state, row in TABLE.items()
        for event, (following, effects) in row.items()
        if following == state and not effects
    }
    assert idle == {("EDITED", "CHANGE"), ("EDITED", "EDIT")}, "these replace what the other playing states do"
