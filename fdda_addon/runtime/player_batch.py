# SPDX-License-Identifier: GPL-3.0-or-later
"""Batches of players: players of one model that move in the same frames run the model once for all their poses.

The position buffers of a batch depend on one batch driver: an object whose driver reads the inputs of all members, and
whose getter plays all members. Blender then evaluates all members whenever one of them moves, so a batch exists only
while frames change. It starts with the second frame in which the same players move, and ends when only some of them
move.
"""

from collections.abc import Mapping
from contextlib import ExitStack, suppress
from itertools import chain, islice

import bpy

from ..core.errors import FDDAError
from . import driver
from .network import Execution, Network
from .player import Player
from .session import session

MIN_BATCH_SIZE = 4
"""Smallest number of players in a batch."""
BATCH_DRIVER_KEY = "fdda_batch_driver"
"""Custom property that marks batch drivers."""


class PlayerBatch:
    """A group of players that one batch driver plays.

    Attributes:
        network: the model of all players.
        members: the players, by the session ids of their position buffers.
    """

    def __init__(self, network: Network, members: Mapping[int, Player]):
        self.network, self.members = network, dict(members)
        self._rows = {player: row for row, player in enumerate(self.members.values())}
        self._execution = Execution(network, len(self.members))

    def batch(self) -> bpy.types.Object:
        """Create the batch driver and make the position buffers of all members depend on it."""
        objects = {o.session_uid: o for o in bpy.data.objects}
        batch_driver = bpy.data.objects.new("FDDA batch", None)
        # A fake user protects the batch driver from Purge Unused Data.
        batch_driver.is_runtime_data, batch_driver.use_fake_user, batch_driver[BATCH_DRIVER_KEY] = True, True, True
        inputs = [p.driver_inputs(objects[p.object_uid], objects[uid]) for uid, p in self.members.items()]
        pose_inputs, dependencies = (chain.from_iterable(member_inputs) for member_inputs in zip(*inputs, strict=True))
        driver.set_driver_inputs(batch_driver, [driver.playback_input(batch_driver), *pose_inputs, *dependencies])
        for uid in self.members:
            driver.set_driver_inputs(objects[uid], [("SINGLE_PROP", batch_driver, "location[0]")])
        return batch_driver

    def unbatch(self) -> None:
        """Give each member a driver of its own again."""
        objects = {o.session_uid: o for o in bpy.data.objects}
        for uid, player in self.members.items():
            mesh_object = objects.get(player.object_uid)
            if mesh_object is not None and uid in objects:
                try:
                    player.update_driver(mesh_object, objects[uid])
                except FDDAError as error:
                    player.error = error

    def play(self, batch_driver: bpy.types.Object) -> None:
        """Write the positions of all members. Each member stores its own exception."""
        with ExitStack() as exit_stack:
            posed_members = []
            input_count = sum(player.pose_input_count for player in self.members.values())
            inputs = iter(driver.evaluated_inputs(batch_driver, input_count))
            for player in self.members.values():
                exit_stack.enter_context(player.lock)
                buffer, mesh_object, armature_object, *owners = islice(inputs, player.pose_input_count)
                with player.capture_errors():
                    if buffer is not None and player.read_pose(mesh_object, armature_object, owners):
                        posed_members.append((player, buffer, mesh_object))
            self._run_model([player for player, _, _ in posed_members if player.new_inputs is not None])
            for player, buffer, mesh_object in posed_members:
                with player.capture_errors():
                    player.write_positions(buffer, mesh_object)

    def _run_model(self, players: list[Player]) -> None:
        """Run the model for players with new inputs: once for all with a strength above 0, alone for each other one."""
        batched_players = [player for player in players if player.new_inputs.strength > 0]
        has_run = False
        if len(batched_players) > 1:
            for player in batched_players:
                self._execution.poses[self._rows[player]] = player.new_inputs.pose_matrices
                self._execution.controls[self._rows[player]] = player.new_inputs.controls
            # If this fails, each player runs the model alone, and stores its own error.
            with suppress(FDDAError):
                # Members without new inputs keep their rows, and so their positions.
                self._execution.run()
                has_run = True
        for player in players:
            with player.capture_errors():
                if has_run and player.new_inputs.strength > 0:
                    player.set_positions(self._execution.positions[self._rows[player]])
                else:
                    player.run_model()


def update(*, frame_changed: bool) -> None:
    """Batch the players that moved in this frame and in the frame before, and unbatch all others.

    Args:
        frame_changed: whether another frame was evaluated.
    """
    previous_count = len(session.batches)
    moved_players: dict[Network, dict[int, Player]] = {}
    for uid, player in session.players.items():
        if player.has_moved:
            player.has_moved = False
            moved_players.setdefault(player.network, {})[uid] = player
    for driver_uid, player_batch in list(session.batches.items()):
        moved_members = moved_players.get(player_batch.network, {})
        if moved_members and not (frame_changed and moved_members.keys() == player_batch.members.keys()):
            _remove_batch(driver_uid)
    for network, members in moved_players.items():
        if not frame_changed or len(members) < MIN_BATCH_SIZE:
            session.moved_buffers.pop(network, None)
        elif session.moved_buffers.get(network) != members.keys():
            session.moved_buffers[network] = set(members)
        elif not any(player_batch.network is network for player_batch in session.batches.values()):
            player_batch = PlayerBatch(network, members)
            session.batches[player_batch.batch().session_uid] = player_batch
    # A new or removed batch driver is no reason to scan.
    session.scanned_count += len(session.batches) - previous_count


def unbatch(buffer_uid: int) -> None:
    """End the batch that plays a position buffer, given by its session id, if there is such a batch."""
    for driver_uid in [uid for uid, player_batch in session.batches.items() if buffer_uid in player_batch.members]:
        _remove_batch(driver_uid)


def remove_unused_drivers() -> None:
    """Remove the batch drivers that play no batch."""
    batch_drivers = [o for o in bpy.data.objects if o.is_runtime_data and BATCH_DRIVER_KEY in o]
    for batch_driver in [o for o in batch_drivers if o.session_uid not in session.batches]:
        bpy.data.objects.remove(batch_driver)


def _remove_batch(driver_uid: int) -> None:
    session.batches.pop(driver_uid).unbatch()
    remove_unused_drivers()
