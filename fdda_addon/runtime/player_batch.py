# SPDX-License-Identifier: GPL-3.0-or-later
"""Batches: players of one model that move in the same frames run the model once for all their poses.

The position buffers of a batch depend on one batch driver: an object whose driver reads the inputs of all members and
whose getter plays them. Blender then evaluates all members whenever one of them moves, so a batch exists only while
frames change. It starts with the second frame in which the same players move, and ends when only some of them do.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from itertools import islice

import bpy

from ..core.errors import FDDAError
from . import driver
from .network import Execution, Network
from .player import Player

MIN_BATCH_SIZE = 4
"""Players in a batch; with fewer, one call for each costs less than waiting for all."""
MAX_EXECUTIONS_IN_USE = 4
"""Executions that a batch keeps besides a new one: arrays of which a member still shows positions."""
BATCH_DRIVER_KEY = "fdda_batch_driver"
"""Custom property that marks batch drivers."""


def is_batch_driver(scene_object: bpy.types.Object) -> bool:
    """Return whether an object is a batch driver of this session."""
    return scene_object.is_runtime_data and BATCH_DRIVER_KEY in scene_object


class PlayerBatch:
    """Players that one batch driver plays.

    Attributes:
        network: the model of all of them.
        members: the players by the session ids of their position buffers.
    """

    def __init__(self, network: Network, members: Mapping[int, Player]):
        self.network, self.members = network, dict(members)
        self._executions: list[Execution] = []

    def batch(self) -> bpy.types.Object:
        """Create the batch driver and make the position buffers of all members depend on it."""
        objects = {o.session_uid: o for o in bpy.data.objects}
        batch_driver = bpy.data.objects.new("FDDA batch", None)
        # A fake user protects it from Purge.
        batch_driver.is_runtime_data, batch_driver.use_fake_user, batch_driver[BATCH_DRIVER_KEY] = True, True, True
        members = [(player, player.find_object(), objects[uid]) for uid, player in self.members.items()]
        pose_inputs = [i for player, mesh_object, buffer in members for i in player.pose_inputs(mesh_object, buffer)]
        dependencies = [i for player, mesh_object, _ in members for i in player.dependency_inputs(mesh_object)]
        driver.set_driver_inputs(batch_driver, [driver.playback_input(batch_driver), *pose_inputs, *dependencies])
        for uid in self.members:
            driver.set_driver_inputs(objects[uid], [("SINGLE_PROP", batch_driver, "location[0]")])
        return batch_driver

    def unbatch(self) -> None:
        """Give each member a driver of its own again."""
        objects = {o.session_uid: o for o in bpy.data.objects}
        for uid, player in self.members.items():
            mesh_object = player.find_object()
            if mesh_object is not None and uid in objects:
                try:
                    player.update_driver(mesh_object, objects[uid])
                except FDDAError as error:
                    player.error = error

    def play(self, batch_driver: bpy.types.Object) -> None:
        """Write the positions of all members; each member stores its own exception."""
        with ExitStack() as stack:
            shown = []
            input_count = sum(player.pose_input_count for player in self.members.values())
            inputs = iter(driver.evaluated_inputs(batch_driver, input_count))
            for player in self.members.values():
                stack.enter_context(player.lock)
                buffer, mesh_object, armature_object, *owners = islice(inputs, player.pose_input_count)
                with player.capture_errors():
                    if buffer is not None and player.read_pose(mesh_object, armature_object, owners):
                        shown.append((player, buffer, mesh_object))
            self._run_model([player for player, _, _ in shown if player.new_inputs is not None])
            for player, buffer, mesh_object in shown:
                with player.capture_errors():
                    player.write_positions(buffer, mesh_object)

    def _run_model(self, players: list[Player]) -> None:
        """Run the model for players with new inputs: once for those that show it, else for each by itself."""
        batched = [player for player in players if player.new_inputs.strength > 0]
        if len(batched) > 1:
            execution = self._free_execution(len(batched))
            for index, player in enumerate(batched):
                execution.poses[index] = player.new_inputs.pose_matrices
                execution.controls[index] = player.new_inputs.controls
            try:
                execution.run()
            except FDDAError:
                # Run by itself, each player stores its own error.
                batched = []
            for index, player in enumerate(batched):
                with player.capture_errors():
                    player.take_positions(execution, index)
        else:
            batched = []
        for player in players:
            if player not in batched:
                with player.capture_errors():
                    player.run_model()

    def _free_execution(self, pose_count: int) -> Execution:
        """Return an execution for a number of poses whose positions no member shows."""
        in_use = {id(player.execution) for player in self.members.values()}
        for execution in self._executions:
            if len(execution.poses) == pose_count and id(execution) not in in_use:
                return execution
        self._executions = [e for e in self._executions if id(e) in in_use][-MAX_EXECUTIONS_IN_USE:]
        self._executions.append(Execution(self.network, pose_count))
        return self._executions[-1]


class PlayerBatches:
    """The batches of the open file.

    Attributes:
        by_driver: the batches by the session ids of their batch drivers.
    """

    def __init__(self) -> None:
        self.by_driver: dict[int, PlayerBatch] = {}
        self._moved_before: dict[Network, set[int]] = {}

    def clear(self) -> None:
        """Forget all batches; their drivers are removed by the next scan."""
        self.by_driver.clear()
        self._moved_before.clear()

    def update(self, players: Mapping[int, Player], frame_changed: bool) -> int:
        """Batch the players that moved in this frame and in the one before; unbatch all others.

        Args:
            players: all players by the session ids of their position buffers.
            frame_changed: the evaluation was of another frame.

        Returns:
            The change in the number of objects in the file.
        """
        previous_count = len(self.by_driver)
        moved: dict[Network, dict[int, Player]] = {}
        for uid, player in players.items():
            if player.has_moved:
                player.has_moved = False
                moved.setdefault(player.network, {})[uid] = player
        for driver_uid, player_batch in list(self.by_driver.items()):
            moved_members = moved.get(player_batch.network, {})
            if moved_members and not (frame_changed and moved_members.keys() == player_batch.members.keys()):
                self._unbatch(driver_uid)
        for network, members in moved.items():
            if not frame_changed or len(members) < MIN_BATCH_SIZE:
                self._moved_before.pop(network, None)
            elif self._moved_before.get(network) != members.keys():
                self._moved_before[network] = set(members)
            elif not any(player_batch.network is network for player_batch in self.by_driver.values()):
                player_batch = PlayerBatch(network, members)
                self.by_driver[player_batch.batch().session_uid] = player_batch
        return len(self.by_driver) - previous_count

    def unbatch(self, buffer_uid: int) -> None:
        """End the batch that plays a position buffer, if there is one."""
        for driver_uid in [uid for uid, player_batch in self.by_driver.items() if buffer_uid in player_batch.members]:
            self._unbatch(driver_uid)

    def _unbatch(self, driver_uid: int) -> None:
        self.by_driver.pop(driver_uid).unbatch()
        for batch_driver in [o for o in bpy.data.objects if o.session_uid == driver_uid]:
            bpy.data.objects.remove(batch_driver)
