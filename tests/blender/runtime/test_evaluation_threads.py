# SPDX-License-Identifier: GPL-3.0-or-later
"""Players on the threads on which Blender evaluates: they are locked, and run again if only a control has changed."""

import bpy
import numpy as np

from fdda_addon.runtime.player import ModelInputs, Player
from fdda_addon.runtime.player_batch import PlayedPose
from fdda_addon.scene.control_reader import ControlReader

from ..conftest import ELBOW_RIG, pose


def test_a_player_is_locked_while_it_reads_the_pose(bound_elbow, monkeypatch):
    """A render and the viewport may evaluate the same character on two threads."""
    read_inputs, lock_states = Player.read_inputs, []

    def record_lock(player: Player, *evaluated_datablocks: object) -> ModelInputs:
        lock_states.append(player.lock.locked())
        return read_inputs(player, *evaluated_datablocks)

    monkeypatch.setattr(Player, "read_inputs", record_lock)
    pose(angle=0.5)
    assert lock_states and all(lock_states)


def test_a_changed_control_runs_the_model_in_an_unchanged_pose(bound_elbow, monkeypatch):
    """An unchanged pose runs the model again only if a control has changed."""
    values, played_controls = [], []

    def record_controls(pose: PlayedPose) -> None:
        played_controls.append(pose.inputs.controls.tolist())
        pose.is_outdated = False

    monkeypatch.setattr(ControlReader, "values", lambda *_: np.array(values, np.float32))
    monkeypatch.setattr(PlayedPose, "run", record_controls)
    for value in (1.0, 1.0, 2.0):
        values[:] = [value]
        bpy.data.objects[ELBOW_RIG].update_tag(refresh={"DATA"})
        bpy.context.view_layer.update()
    assert played_controls == [[1.0], [2.0]]
