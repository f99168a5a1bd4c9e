# SPDX-License-Identifier: GPL-3.0-or-later
"""The playback session: what the add-on knows about the open file. `session` is the only global of this package.

The session holds names and session ids, never RNA objects, which an undo or the load of a file invalidates. Players,
batches and models have the type `Any`, because their modules import this one.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import FDDAError, ModelError
from .transitions import SHOWS_MODEL, TABLE, Effect, Event, State, transition

CHECK_DELAY_S = 0.25
"""How long updates have to pause before changed rigs are checked. In the background they are checked at once."""


@dataclass
class Character:
    """A bound mesh object.

    Attributes:
        name: name of the object when it was last found.
        object_uid: session id of the object.
        state: its state (`transitions`).
        player: the `player.Player` that runs the model; None unless the model is shown.
        buffer_uid: session id of its position buffer, which it keeps while its rig is shown; 0 for none.
        animated: keyed and driven settings (`modifier_switch.animated_settings`).
        reported: parts of the rig that may have changed since the last check (`rig_signature`).
    """

    name: str
    object_uid: int
    state: State = State.UNBOUND
    player: Any = None
    buffer_uid: int = 0
    animated: frozenset[str] = frozenset()
    reported: set[str] = field(default_factory=set)

    def find_object(self) -> bpy.types.Object | None:
        """Find the object, even if it was renamed; return None if it was removed or is no longer bound."""
        mesh_object = bpy.data.objects.get(self.name)
        if mesh_object is None or mesh_object.session_uid != self.object_uid:
            mesh_object = next((o for o in bpy.data.objects if o.session_uid == self.object_uid), None)
            if mesh_object is None:
                return None
            self.name = mesh_object.name
        return mesh_object if mesh_object.fdda.is_bound else None


class PlaybackSession:
    """The characters of the open file, and what is loaded and checked for them.

    Attributes:
        characters: the bound objects, by their session ids.
        batches: batches of players, by the session ids of the position buffers that have their drivers
            (`player_batch`). Threads that evaluate read this table.
        moved_groups: by model: the groups of players that moved in the last frame.
        passed_checks: by the session id of a mesh object: its mesh, the rig that its model requires, and the signature
            of the rig that passed (`rig_signature`).
        read_bones: the bones that a check has read, by the session id of the armature and whether envelopes were read;
            None while nothing is checked.
        modes: stacks of overriding modes, by the session ids of objects. The last mode of a stack is in effect.
        networks: the loaded models, by their paths or by the session ids of their text datablocks; with each, the time
            of modification and the size of its file.
        chosen_paths: paths of the models that the user chose since Blender started.
        needs_scan: whether to scan after the next evaluation, even if the number of objects is the same.
        scanned_count: number of objects in the file at the last scan.
        suspension_count: number of saves that have begun and not ended. A handler of another add-on may save a copy
            before Blender writes the file itself.
        is_switching: whether an animated mode is being applied.
        apply_effect: applies an effect to a character; `effects`, which imports this module, sets it.
        check_timer: the timer that checks changed rigs.
    """

    def __init__(self) -> None:
        self.characters: dict[int, Character] = {}
        self.batches: dict[int, Any] = {}
        self.moved_groups: dict[Any, set[Any]] = {}
        self.passed_checks: dict[int, tuple] = {}
        self.modes: dict[int, list[str]] = {}
        self.networks: dict[Path | int, tuple[tuple, Any]] = {}
        self.chosen_paths: set[Path] = set()
        self.needs_scan, self.scanned_count = True, 0
        self.suspension_count = 0
        self.is_switching = False
        self.apply_effect: Callable[[Effect, Character, FDDAError | None], None]
        self._count_without_bound: int | None = None
        self.read_bones: dict[tuple[int, bool], tuple] | None = None
        self._last_change = 0.0
        # Blender compares timers by identity, and each access makes another bound method.
        self.check_timer = self._check_after_pause

    def has_bound_objects(self) -> bool:
        """Return whether an object is or was bound in this file; counting objects is quick, looking at each is not."""
        if self.characters:
            return True
        count = len(bpy.data.objects)
        if count == self._count_without_bound:
            return False
        if any(o.type == "MESH" and o.fdda.is_bound for o in bpy.data.objects):
            return True
        self._count_without_bound = count
        return False

    def reset(self, *, keep_checks: bool = False) -> None:
        """Forget the characters of the file, which a scan finds again; the data of Blender stay as they are.

        Args:
            keep_checks: keep the passed checks, because names still refer to the same datablocks.
        """
        self.suspension_count = 0
        for table in (self.characters, self.batches, self.moved_groups):
            table.clear()
        self.needs_scan, self._count_without_bound = True, None
        if not keep_checks:
            self.passed_checks.clear()

    def character_of(self, mesh_object: bpy.types.Object) -> Character:
        """Return the character of a bound object, and begin to follow it if the session does not know it."""
        character = self.characters.get(mesh_object.session_uid)
        if character is None:
            character = Character(mesh_object.name, mesh_object.session_uid)
            self.characters[character.object_uid] = character
            self.dispatch(Event.BIND, character)
        return character

    def dispatch(self, event: Event, character: Character | None = None, error: FDDAError | None = None) -> None:
        """Change the state of a character, and apply the effects in their order.

        Args:
            event: what happened.
            character: the character; None for all characters of the file.
            error: the reason of `Event.FAIL`.
        """
        for each in [character] if character else list(self.characters.values()):
            if event not in TABLE[each.state]:
                continue  # Most frames dispatch to characters for which nothing changes.
            state, effect_list = transition(each.state, event)
            each.state = state
            with self.isolated_errors(each):
                for effect in effect_list:
                    self.apply_effect(effect, each, error)
            if state == State.UNBOUND and event == Event.UNBIND:
                self.characters.pop(each.object_uid, None)

    @contextmanager
    def isolated_errors(self, character: Character) -> Iterator[None]:
        """Show the rig of a character if the block fails for it; the other characters continue to play."""
        try:
            yield
        except FDDAError as error:
            self.dispatch(Event.FAIL, character, error)
        except Exception as error:
            # Any exception is caught here, because an exception in a handler would stop all characters.
            message = f"The model of '{character.name}' cannot be played ({error!r}); bind it again."
            self.dispatch(Event.FAIL, character, ModelError(message))

    def report_change(self, character: Character, part: str) -> None:
        """Note that a part of a rig may have changed (`rig_signature`)."""
        if character.state in SHOWS_MODEL:
            character.reported.add(part)
            self.dispatch(Event.CHANGE, character)

    def check_rigs(self) -> None:
        """Check the rigs that may have changed; an armature that characters share is read once."""
        self.read_bones = {}
        try:
            self.dispatch(Event.CHECK)
        finally:
            self.read_bones = None

    def schedule_check(self) -> None:
        """Check the changed rigs when no update has changed them for a moment."""
        self._last_change = time.monotonic()
        if not bpy.app.background and not bpy.app.timers.is_registered(self.check_timer):
            bpy.app.timers.register(self.check_timer, first_interval=CHECK_DELAY_S)

    def _check_after_pause(self) -> float | None:
        """Check the changed rigs, unless one has just changed again; the timer then waits for the returned seconds."""
        remaining = CHECK_DELAY_S - (time.monotonic() - self._last_change)
        if remaining > 0:
            return remaining
        self.check_rigs()
        return None

    def overriding_mode(self, object_uid: int) -> str:
        """Return the mode that overrides the mode of an object; empty if there is none."""
        mode_stack = self.modes.get(object_uid)
        return mode_stack[-1] if mode_stack else ""

    def uses_model(self, mesh_object: bpy.types.Object) -> bool:
        """Return whether a bound object shows its model, according to its overriding mode or else its own mode.

        Only its own mode plays a model again that has failed: the failure has set it to RIG.
        """
        character = self.characters.get(mesh_object.session_uid)
        has_failed = character is not None and character.state == State.FAILED
        overriding_mode = "" if has_failed else self.overriding_mode(mesh_object.session_uid)
        return (overriding_mode or mesh_object.fdda.mode) != "RIG"


session = PlaybackSession()
