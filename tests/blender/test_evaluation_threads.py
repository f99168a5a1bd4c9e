# SPDX-License-Identifier: GPL-3.0-or-later
"""Python keeps the state of the threads on which Blender evaluates, and of few others."""

import threading
from collections import Counter

import bpy
import numpy as np
import pytest

from fdda_addon.runtime import evaluation_threads, playback
from fdda_addon.runtime.player import Player
from fdda_addon.scene.controls import ControlReader

from .conftest import ELBOW_RIG, assert_plays, pose

MOST_POSES = 2000


def test_python_knows_the_threads_that_evaluate(bound, elbow, monkeypatch):
    """What is local to a thread goes with the state that Python has of it."""
    calls, remembered, own = Counter(), {}, threading.local()
    play = playback.on_evaluate

    def counted(driven: bpy.types.Object) -> None:
        play(driven)
        calls[threading.get_ident()] += 1
        own.calls = getattr(own, "calls", 0) + 1
        remembered[threading.get_ident()] = own.calls

    monkeypatch.setattr(playback, "on_evaluate", counted)
    main = threading.get_ident()
    for number in range(MOST_POSES):
        pose(angle=number / MOST_POSES)
        if max((count for thread, count in calls.items() if thread != main), default=0) >= 10:
            break
    else:
        pytest.skip("Blender evaluates on one thread here")
    assert remembered == calls
    assert_plays(bound, elbow.model)


def test_a_player_is_locked_while_it_reads(bound, monkeypatch):
    """A render may evaluate it on another thread while the window does."""
    read_pose, locked = Player.read_pose, []

    def noted(player: Player, *evaluated: object) -> bool:
        locked.append(player.lock.locked())
        return read_pose(player, *evaluated)

    monkeypatch.setattr(Player, "read_pose", noted)
    pose(angle=0.5)
    assert locked and all(locked)


def test_a_control_alone_is_played(bound, monkeypatch):
    """A pose that has not changed runs no model, unless a control has."""
    values, played, run_model = [], [], Player.run_model

    def noted(player: Player) -> None:
        played.append(player.new_inputs.controls.tolist())
        player.new_inputs = player.new_inputs._replace(controls=np.zeros(0, np.float32))
        run_model(player)

    monkeypatch.setattr(ControlReader, "values", lambda *_: np.array(values, np.float32))
    monkeypatch.setattr(Player, "run_model", noted)
    for value in (1.0, 1.0, 2.0):
        values[:] = [value]
        bpy.data.objects[ELBOW_RIG].update_tag(refresh={"DATA"})
        bpy.context.view_layer.update()
    assert played == [[1.0], [2.0]]


def test_states_of_threads_that_end_are_few(monkeypatch):
    monkeypatch.setattr(evaluation_threads, "_thread_ids_with_state", {threading.get_ident()})
    count, ended = evaluation_threads.MAX_KEPT_STATES + 5, []
    # Threads that are there at once are told apart; the next one has the name of one that has ended.
    all_there = threading.Barrier(count)

    def short() -> None:
        all_there.wait(10)
        evaluation_threads.keep_thread_state()
        evaluation_threads.keep_thread_state()
        ended.append(threading.get_ident())

    at_once = [threading.Thread(target=short) for _ in range(count)]
    for thread in at_once:
        thread.start()
    for thread in at_once:
        thread.join(10)
    assert len(ended) == count and not any(thread.is_alive() for thread in at_once)
    assert len(evaluation_threads._thread_ids_with_state) == evaluation_threads.MAX_KEPT_STATES
