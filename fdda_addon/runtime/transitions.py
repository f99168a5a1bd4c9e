# SPDX-License-Identifier: GPL-3.0-or-later
"""The states of a bound character, and what each event changes: a table, without Blender.

`session.PlaybackSession.dispatch` looks up the transition, sets the state, and lets `effects` apply the effects in
their order. An event that the table does not name for a state changes nothing.
"""

from enum import Enum
from typing import NamedTuple


class State(Enum):
    """State of a character."""

    UNBOUND = "no model is bound"
    BOUND = "the mode shows the rig"
    PLAYING = "the model plays, and its rig is checked"
    CHANGED = "the model plays, and its rig may have changed since the check"
    EDITED = "the model plays, and its mesh is being edited"
    SUSPENDED = "the rig is shown while the file is written; the model plays again afterwards"
    FAILED = "the rig is shown, because the model cannot play; the status has the reason"


class Event(Enum):
    """What happened to a character."""

    BIND = "a bound object was found"
    UNBIND = "the object was unbound or removed"
    CHOOSE_MODEL = "a user or a script has chosen to show the model"
    ANIMATE_MODEL = "keyframes or drivers show the model, or a scan has found that the mode shows it"
    SHOW_RIG = "the mode, its keyframes or drivers, or an override show the rig"
    SUSPEND = "the file is about to be written"
    RESUME = "the file was written"
    CHANGE = "Blender reported an update that may have changed the rig"
    CHECK = "the updates have paused, or a frame is evaluated"
    EDIT_OBJECT = "Blender reported an edit of the object, or a scan has found it"
    REPLAY = "the same pose has to be played again: with another mask, or in another dependency graph"
    WARN = "the player has another warning"
    EDIT = "the mesh is in a mode that changes it"
    LEAVE_EDIT = "the mesh has left that mode"
    OUTDATE = "the player no longer fits its object, rig or model"
    FAIL = "the model cannot be loaded, fitted or run"


class Effect(Enum):
    """What `effects` does to the data of Blender and to the session."""

    SHOW_MODEL = "switch the modifiers of the rig off and the FDDA modifier on"
    SHOW_RIG = "switch the modifiers of the rig on and the FDDA modifier off"
    DISCONNECT = "disconnect the position buffer, so that the FDDA modifier changes nothing even if it gets visible"
    CREATE_PLAYER = "connect a position buffer and create the player, which checks the rig"
    REMOVE_PLAYER = "remove the player"
    FORGET_CHECK = "read the whole rig in the next check"
    SCHEDULE_CHECK = "check the rig after a pause"
    CHECK_RIG = "compare the signature of the rig; an outdated player is created again"
    READ_VISIBILITY = "set the mode from the visibility of the FDDA modifier, in case the user has changed it"
    TAG_BUFFER = "make Blender evaluate the position buffer again"
    SHOW_WARNING = "set the status to the warning of the player"
    CLEAR_STATUS = "clear the status"
    REPORT = "set the mode RIG, and report the reason"


class Transition(NamedTuple):
    """The next state, and the effects that lead to it."""

    state: State
    effects: tuple[Effect, ...] = ()


SHOWS_MODEL = frozenset({State.PLAYING, State.CHANGED, State.EDITED})
"""States in which the model is shown and a player exists."""

_START = Transition(State.PLAYING, (Effect.SHOW_MODEL, Effect.CREATE_PLAYER))
_RESTART = Transition(State.PLAYING, (Effect.REMOVE_PLAYER, Effect.CREATE_PLAYER))
_PAUSE = (Effect.REMOVE_PLAYER, Effect.SHOW_RIG)
_STOP = (*_PAUSE, Effect.DISCONNECT)


def _bound_row(state: State) -> dict[Event, Transition]:
    """Return what all states of a bound character have in common."""
    return {
        Event.UNBIND: Transition(State.UNBOUND),
        Event.EDIT_OBJECT: Transition(state, (Effect.READ_VISIBILITY,)),
    }


def _playing_row(state: State) -> dict[Event, Transition]:
    """Return what the states have in common in which the model is shown."""
    return _bound_row(state) | {
        Event.UNBIND: Transition(State.UNBOUND, _STOP),
        # Whether renders show the model may have changed.
        Event.CHOOSE_MODEL: Transition(state, (Effect.SHOW_MODEL,)),
        Event.SHOW_RIG: Transition(State.BOUND, (*_STOP, Effect.CLEAR_STATUS)),
        # Connected: else Blender may drop an override that has no other change when it opens the written file.
        Event.SUSPEND: Transition(State.SUSPENDED, _PAUSE),
        Event.CHANGE: Transition(State.CHANGED, (Effect.SCHEDULE_CHECK,)),
        Event.REPLAY: Transition(state, (Effect.TAG_BUFFER,)),
        Event.WARN: Transition(state, (Effect.SHOW_WARNING,)),
        Event.EDIT: Transition(State.EDITED),
        Event.OUTDATE: _RESTART,
        # The reason is reported first: another effect may fail, too.
        Event.FAIL: Transition(State.FAILED, (Effect.REPORT, *_STOP)),
    }


TABLE: dict[State, dict[Event, Transition]] = {
    State.UNBOUND: {Event.BIND: Transition(State.BOUND)},
    State.BOUND: _bound_row(State.BOUND)
    | {
        Event.CHOOSE_MODEL: _START,
        Event.ANIMATE_MODEL: _START,
        # A duplicate of a playing object has its modifiers and its position buffer.
        Event.SHOW_RIG: Transition(State.BOUND, (Effect.SHOW_RIG, Effect.DISCONNECT)),
        Event.FAIL: Transition(State.FAILED, (Effect.REPORT, Effect.SHOW_RIG, Effect.DISCONNECT)),
    },
    State.PLAYING: _playing_row(State.PLAYING),
    State.CHANGED: _playing_row(State.CHANGED) | {Event.CHECK: Transition(State.PLAYING, (Effect.CHECK_RIG,))},
    State.EDITED: _playing_row(State.EDITED)
    | {
        Event.CHANGE: Transition(State.EDITED),
        Event.LEAVE_EDIT: Transition(State.PLAYING, (Effect.FORGET_CHECK, *_RESTART.effects)),
    },
    State.SUSPENDED: _bound_row(State.SUSPENDED)
    | {
        Event.UNBIND: Transition(State.UNBOUND, (Effect.DISCONNECT,)),
        Event.SHOW_RIG: Transition(State.BOUND, (Effect.DISCONNECT,)),
        Event.RESUME: _START,
        Event.FAIL: Transition(State.FAILED, (Effect.REPORT, Effect.DISCONNECT)),
    },
    State.FAILED: _bound_row(State.FAILED) | {Event.CHOOSE_MODEL: _START},
}


def transition(state: State, event: Event) -> Transition:
    """Return the transition of a character; without an entry in the table, the state stays and nothing is done."""
    return TABLE[state].get(event) or Transition(state)
