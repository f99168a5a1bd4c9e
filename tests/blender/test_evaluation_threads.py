# SPDX-License-Identifier: GPL-3.0-or-later
"""Python states of the threads on which Blender evaluates: they are kept, but only a limited number."""

import threading
from collections import Counter

import bpy
import numpy as np
import pytest

from fdda_addon.runtime import evaluation_threads, playback
from fdda_addon.runtime.player import Player
from fdda_addon.scene.control_reader import ControlReader

from .conftest import ELBOW_RIG, assert_plays, pose

MAX_POSES = 2000


def test_thread_local_data_is_kept_between_evaluations(bound_elbow, elbow_files, monkeypatch):
    """Python deletes thread-local data when it deletes the state of a thread."""
    calls, local_counts, local_data = Counter(), {}, threading.local()
    on_evaluate = playback.on_evaluate

    def count_calls(driven: bpy.types.Object) -> None:
        on_evaluate(driven)
        calls[threading.get_ident()] += 1
        local_data.calls = getattr(local_data, "calls", 0) + 1
        local_counts[threading.get_ident()] = local_data.calls

    monkeypatch.setattr(playback, "on_evaluate", count_calls)
    main_thread = threading.get_ident()
    for index in range(MAX_POSES):
        pose(angle=index / MAX_POSES)
        if max((count for thread, count in calls.items() if thread != main_thread), default=0) >= 10:
            break
    else:
        pytest.skip("Blender evaluates on one thread here")
    assert local_counts == calls
    assert_plays(bound_elbow, elbow_files.model)


def test_a_player_is_locked_while_it_reads_the_pose(bound_elbow, monkeypatch):
    """A render and the viewport may evaluate the same character on two threads."""
    read_pose, lock_states = Player.read_pose, []

    def record_lock(player: Player, *evaluated_positions: object) -> bool:
        lock_states.append(player.lock.locked())
        return read_pose(player, *evaluated_positions)

    monkeypatch.setattr(Player, "read_pose", record_lock)
    pose(angle=0.5)
    assert lock_states and all(lock_states)


def test_a_changed_control_runs_the_model_in_an_unchanged_pose(bound_elbow, monkeypatch):
    """An unchanged pose runs the model again only if a control has changed."""
    values, played_controls, run_model = [], [], Player.run_model

    def record_controls(player: Player) -> None:
        played_controls.append(player.new_inputs.controls.tolist())
        player.new_inputs = player.new_inputs._replace(controls=np.zeros(0, np.float32))
        run_model(player)

    monkeypatch.setattr(ControlReader, "values", lambda *_: np.array(values, np.float32))
    monkeypatch.setattr(Player, "run_model", record_controls)
    for value in (1.0, 1.0, 2.0):
        values[:] = [value]
        bpy.data.objects[ELBOW_RIG].update_tag(refresh={"DATA"})
        bpy.context.view_layer.update()
    assert played_controls == [[1.0], [2.0]]


def test_the_number_of_kept_states_of_ended_threads_is_limited(monkeypatch):
    monkeypatch.setattr(evaluation_threads, "_thread_ids_with_state", {threading.get_ident()})
    count, ended_threads = evaluation_threads.MAX_KEPT_STATES + 5, []
    # All threads run at the same time: a new thread may get the identifier of a thread that has ended.
    all_started = threading.Barrier(count)

    def keep_state_twice() -> None:
        all_started.wait(10)
        evaluation_threads.keep_thread_state()
        evaluation_threads.keep_thread_state()
        ended_threads.append(threading.get_ident())

    threads = [threading.Thread(target=keep_state_twice) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert len(ended_threads) == count and not any(thread.is_alive() for thread in threads)
    assert len(evaluation_threads._thread_ids_with_state) == evaluation_threads.MAX_KEPT_STATES
