# SPDX-License-Identifier: GPL-3.0-or-later
"""Players on the threads on which Blender evaluates: they are locked, and run again if only a control has changed."""

import bpy
import numpy as np

from fdda_addon.runtime.player import Player
from fdda_addon.scene.control_reader import ControlReader

from ..conftest import ELBOW_RIG, pose


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
