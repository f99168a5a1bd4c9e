# SPDX-License-Identifier: GPL-3.0-or-later
"""The table of a character's states: all pairs of state and event, and sequences of events, without Blender."""

from dataclasses import dataclass

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule

from fdda_addon.runtime.transitions import SHOWS_MODEL, Effect, Event, State, transition

ALL_PAIRS = [(state, event) for state in State for event in Event]
BOUND_STATES = set(State) - {State.UNBOUND}


@dataclass
class Scene:
    """What the effects change: a character as Blender shows it.

    Attributes:
        shows_model: whether the modifiers of the rig are off.
        has_player: whether a player exists.
        is_connected: whether the FDDA modifier reads a position buffer.
        is_unchecked: whether the rig may have changed since the check.
        check_is_scheduled: whether a check will come.
        reports: number of reports to the user.
    """

    shows_model: bool = False
    has_player: bool = False
    is_connected: bool = False
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
            self.has_player, self.is_unchecked, self.is_connected = True, False, True
        elif effect == Effect.DISCONNECT:
            assert not self.has_player, "a player writes to a buffer that the modifier reads"
            self.is_connected = False
        elif effect == Effect.REMOVE_PLAYER:
            self.has_player = self.is_unchecked = self.check_is_scheduled = False
        elif effect in (Effect.TAG_BUFFER, Effect.SHOW_WARNING):
            assert self.has_player
        elif effect == Effect.SCHEDULE_CHECK:
            self.check_is_scheduled = True
        elif effect == Effect.CHECK_RIG:
            assert self.has_player
            self.is_unchecked = self.check_is_scheduled = False
        elif effect == Effect.REPORT:
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
        assert scene.is_connected == (state in SHOWS_MODEL | {State.SUSPENDED}), step
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
    for _ in State:
        for each, path in list(paths.items()):
            for event in Event:
                paths.setdefault(transition(each, event).state, [*path, event])
    assert state in paths, f"no events lead to {state.name}"
    walk = Walk()
    for event in paths[state]:
        walk.dispatch(event)
    assert walk.state == state
    return walk


class EventSequence(RuleBasedStateMachine):
    """Dispatches events to a character; Hypothesis searches for the shortest sequence after which a check fails."""

    def __init__(self) -> None:
        super().__init__()
        self.walk = Walk()

    @rule(event=st.sampled_from(Event))
    def dispatch(self, event: Event) -> None:
        self.walk.dispatch(event)


# The same sequences in each run, and no folder with found examples.
EventSequence.TestCase.settings = settings(
    max_examples=100, stateful_step_count=100, derandomize=True, database=None, deadline=None
)
TestEventSequences = EventSequence.TestCase


def test_every_state_is_reachable_and_every_bound_character_can_play_again():
    assert reachable(State.UNBOUND) == set(State)
    for state in BOUND_STATES:
        assert State.PLAYING in reachable(state), f"a character is frozen in {state.name}"
        assert State.UNBOUND in reachable(state)


NEXT_STATES = {
    Event.BIND: {State.BOUND: {State.UNBOUND}},
    Event.UNBIND: {State.UNBOUND: BOUND_STATES},
    Event.CHOOSE_MODEL: {State.PLAYING: {State.BOUND, State.FAILED}},
    Event.ANIMATE_MODEL: {State.PLAYING: {State.BOUND}},
    Event.SHOW_RIG: {State.BOUND: SHOWS_MODEL | {State.SUSPENDED}},
    Event.SUSPEND: {State.SUSPENDED: SHOWS_MODEL},
    Event.RESUME: {State.PLAYING: {State.SUSPENDED}},
    Event.CHANGE: {State.CHANGED: {State.PLAYING}},
    Event.CHECK: {State.PLAYING: {State.CHANGED}},
    Event.EDIT: {State.EDITED: {State.PLAYING, State.CHANGED}},
    Event.LEAVE_EDIT: {State.PLAYING: {State.EDITED}},
    Event.OUTDATE: {State.PLAYING: SHOWS_MODEL},
    Event.FAIL: {State.FAILED: BOUND_STATES},
}
"""What users expect: the mode decides, a written file shows rigs, and a failure stays until the user acts.

By event: the next states, each with the former states that the event changes to it. All other states stay.
"""


@pytest.mark.parametrize("event", Event, ids=lambda event: event.name.lower())
def test_what_users_expect(event: Event):
    expected = {state: state for state in State}
    for following, former_states in NEXT_STATES.get(event, {}).items():
        expected |= dict.fromkeys(former_states, following)
    assert {state: transition(state, event).state for state in State} == expected
