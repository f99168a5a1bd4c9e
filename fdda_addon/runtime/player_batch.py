# SPDX-License-Identifier: GPL-3.0-or-later
"""Batches of players: players of one model that read their poses in one driver and run the model once.

The players of one armature object are a group, which reads one pose. Each group is a batch of its own, except in a
crowd: groups of one model that move in the same frames become one batch. Blender then evaluates all of them whenever
one of them moves, so a batch of several groups exists only while frames change. It starts with the second frame in
which the same groups move, and ends when only some of them move.

The driver of a batch belongs to the position buffer of its first player. The other buffers depend on that buffer.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from weakref import WeakKeyDictionary

import bpy
import numpy as np

from ..core.errors import FDDAError
from ..core.formats.pose_repair import repair_pose
from . import driver
from .network import Execution, Network
from .player import ModelInputs, Player
from .session import session

MIN_BATCH_SIZE = 4
"""Smallest number of groups in a batch of several groups."""


class PlayedPose:
    """A pose, and the positions that a model has for it.

    Attributes:
        inputs: the inputs of the model; None before the first pose.
        positions: (V, 3) float32, the output of the model for the last inputs for which it was run.
        is_outdated: whether the model has not run for `inputs`.
    """

    def __init__(self, network: Network):
        self._network, self._execution = network, Execution(network, 1)
        self._key: tuple[bytes, bytes, str] | None = None
        self.inputs: ModelInputs | None = None
        # A model that cannot run fails here, and not in an evaluation.
        self._execution.poses[0] = network.info.rest_matrices
        self.positions = self._execution.run()[0]
        self.is_outdated = True

    def update(self, inputs: ModelInputs, armature_name: str) -> None:
        """Set the inputs if they have changed."""
        # Bytes are compared, because a pose may have values that are not numbers.
        key = inputs.pose_matrices.tobytes(), inputs.controls.tobytes(), inputs.warning
        if key == self._key:
            return
        self._key, self.is_outdated = key, True
        if not np.isfinite(inputs.pose_matrices).all():
            pose_matrices, joint_name = repair_pose(inputs.pose_matrices, self._network.info)
            warning = (
                f"The pose of the joint '{joint_name}' of '{armature_name}' is not a number; what it moves follows the "
                "joint above."
            )
            inputs = ModelInputs(pose_matrices, inputs.controls, warning)
        self.inputs = inputs

    def set_row(self, execution: Execution, row: int) -> None:
        """Set the inputs of one pose of an execution."""
        execution.poses[row], execution.controls[row] = self.inputs.pose_matrices, self.inputs.controls

    def run(self) -> None:
        """Run the model for this pose alone."""
        self.set_row(self._execution, 0)
        self.positions, self.is_outdated = self._execution.run()[0], False


class PlayerGroup:
    """The players of one model on one armature object. They share a pose.

    Attributes:
        network: the model of all players.
        armature_object_uid: session id of the armature object.
        members: the players, by the session ids of their position buffers.
        pose: the pose that the players share.
        has_moved: whether the pose or a strength has changed since the last update of the batches.
    """

    def __init__(self, player: Player):
        self.network, self.armature_object_uid = player.network.model, player.armature_object_uid
        self.members: dict[int, Player] = {}
        self.pose = PlayedPose(self.network)
        # The poses of the players whose objects have moved against that of the first player.
        self._moved_poses: WeakKeyDictionary[Player, PlayedPose] = WeakKeyDictionary()
        self.has_moved = False

    def driver_inputs(
        self, objects: dict[int, bpy.types.Object]
    ) -> tuple[list[Player], list[driver.DriverInput], list[driver.DriverInput]]:
        """Return the players whose objects exist, the driver variables that `read_pose` takes, and other variables.

        A variable that `read_pose` takes has no datablock if a control belongs to a mesh that the file lacks.

        Args:
            objects: the objects of the file, by their session ids.
        """
        players, buffers, dependencies, first_inputs = [], [], [], []
        for uid, player in self.members.items():
            mesh_object, buffer = objects.get(player.object_uid), objects.get(uid)
            if mesh_object is None or buffer is None:
                continue
            try:
                if not players:
                    scene_rig = player.scene_rig(mesh_object)
                    first_inputs = driver.pose_inputs(scene_rig, player.control_sources)
                    dependencies += driver.joint_inputs(scene_rig, self.network.info.joint_names)
            except FDDAError as error:
                player.store_error(error)
                continue
            buffers += driver.buffer_inputs(buffer, mesh_object)
            dependencies += driver.setting_inputs(mesh_object)
            players.append(player)
        return players, [*first_inputs, *buffers], dependencies

    def read_pose(
        self, players: Sequence[Player], armature_object: bpy.types.Object | None, *datablocks: bpy.types.ID | None
    ) -> list[tuple[PlayedPose, Player, bpy.types.Object, bpy.types.Object]]:
        """Read the pose of evaluated objects.

        Args:
            players: the players of `driver_inputs`.
            armature_object, datablocks: the evaluated datablocks of its variables.

        Returns:
            The players that have positions to write, each with its pose, its evaluated position buffer and its
            evaluated mesh object.
        """
        owners, objects = datablocks[: -2 * len(players)], datablocks[-2 * len(players) :]
        posed_players, first_player = [], None
        for player, buffer, mesh_object in zip(players, objects[::2], objects[1::2], strict=True):
            try:
                if armature_object is None or mesh_object is None or buffer is None:
                    continue
                if not player.fits_pose(mesh_object, armature_object):
                    continue
                pose = self.pose
                if first_player is None or not player.shares_pose(first_player, mesh_object, armature_object):
                    inputs = player.read_inputs(mesh_object, armature_object, owners)
                    if inputs is None:
                        continue
                    if first_player is None:
                        first_player = player
                    else:
                        pose = self._moved_poses[player] = self._moved_poses.get(player) or PlayedPose(self.network)
                    pose.update(inputs, armature_object.name)
                posed_players.append((pose, player, buffer, mesh_object))
            except BaseException as error:  # SystemExit too.
                player.store_error(error)
        return posed_players


class PlayerBatch:
    """Groups that one driver plays.

    Attributes:
        network: the model of all players.
        groups: the groups.
        driven_uid: session id of the position buffer that has the driver; 0 if there is none.
    """

    def __init__(self, groups: Iterable[PlayerGroup], objects: dict[int, bpy.types.Object]):
        """Create the driver, and make the position buffers of all players depend on it.

        Args:
            groups: groups of one model.
            objects: the objects of the file, by their session ids.
        """
        self.groups, self.driven_uid = list(groups), 0
        self.network = self.groups[0].network
        self._execution = Execution(self.network, len(self.groups)) if len(self.groups) > 1 else None
        # The driver keeps its variables when a player is removed, so the batch keeps the players.
        self._rows: list[tuple[PlayerGroup, list[Player], list[bool]]] = []
        pose_inputs, dependencies, buffers = [], [], []
        for group in self.groups:
            players, group_inputs, group_dependencies = group.driver_inputs(objects)
            if players:
                # A variable without a datablock would make the driver invalid.
                self._rows.append((group, players, [datablock is not None for _, datablock, _ in group_inputs]))
                pose_inputs += [group_input for group_input in group_inputs if group_input[1] is not None]
                dependencies += group_dependencies
                buffers += [objects[uid] for uid, player in group.members.items() if player in players]
        self._players, self._input_count = (
            [player for _, players, _ in self._rows for player in players],
            len(pose_inputs),
        )
        if buffers:
            first_buffer, *other_buffers = buffers
            self.driven_uid = first_buffer.session_uid
            playback_input = driver.playback_input(first_buffer)
            driver.set_driver_inputs(first_buffer, [playback_input, *pose_inputs, *dependencies])
            for buffer in other_buffers:
                driver.set_driver_inputs(buffer, [("SINGLE_PROP", first_buffer, "location[0]")])

    def play(self, driven_buffer: bpy.types.Object) -> None:
        """Write the positions of all players. Each player stores its own exception."""
        for player in self._players:
            player.lock.acquire()
        try:
            self._play(driven_buffer)
        except BaseException as error:  # SystemExit too.
            for player in self._players:
                player.store_error(error)
        finally:
            for player in self._players:
                player.lock.release()

    def _play(self, driven_buffer: bpy.types.Object) -> None:
        datablocks = iter(driver.evaluated_inputs(driven_buffer, self._input_count))
        posed_players, outdated_rows = [], []
        for row, (group, players, are_present) in enumerate(self._rows):
            needs_run = False
            group_datablocks = [next(datablocks) if is_present else None for is_present in are_present]
            for pose, player, buffer, mesh_object in group.read_pose(players, *group_datablocks):
                is_outdated = player.is_outdated(pose.inputs, mesh_object)
                group.has_moved |= is_outdated
                needs_run |= is_outdated and pose is group.pose and pose.is_outdated and player.strength > 0
                posed_players.append((pose, player, buffer, mesh_object, is_outdated))
            if needs_run:
                outdated_rows.append((row, group.pose))
        if len(outdated_rows) > 1:
            # If this fails, each group runs the model alone, and its players store the error.
            with suppress(FDDAError):
                self._run_model(outdated_rows)
        for pose, player, buffer, mesh_object, is_outdated in posed_players:
            try:
                if is_outdated:
                    if pose.is_outdated and player.strength > 0:
                        pose.run()
                    player.set_positions(pose.inputs, pose.positions, mesh_object)
                player.write_positions(buffer, mesh_object)
            except BaseException as error:  # SystemExit too.
                player.store_error(error)

    def _run_model(self, rows: Sequence[tuple[int, PlayedPose]]) -> None:
        """Run the model once for several poses. The other poses keep their rows, and so their positions."""
        for row, pose in rows:
            pose.set_row(self._execution, row)
        positions = self._execution.run()
        for row, pose in rows:
            pose.positions, pose.is_outdated = positions[row], False


def add_player(buffer_uid: int, player: Player) -> None:
    """Play a player, given the session id of its position buffer, with the others of its armature object and model.

    Raises:
        ModelError: the model cannot run.
    """

    def fits(group: PlayerGroup) -> bool:
        return group.network is player.network.model and group.armature_object_uid == player.armature_object_uid

    batches = [b for b in session.batches.values() if b.driven_uid == buffer_uid or any(map(fits, b.groups))]
    groups = [group for player_batch in batches for group in player_batch.groups]
    if not any(map(fits, groups)):
        groups.append(PlayerGroup(player))
    next(filter(fits, groups)).members[buffer_uid] = player
    _replace_batches(batches, [[group] for group in groups])


def remove_player(buffer_uid: int) -> None:
    """Remove the player of a position buffer, if there is one. The next scan updates the drivers of the others."""
    for player_batch in session.batches.values():
        for group in player_batch.groups:
            group.members.pop(buffer_uid, None)
    session.needs_scan = True


def update_drivers() -> None:
    """Make each group a batch of its own, and update the drivers if objects have changed."""
    session.moved_groups.clear()
    batches = list(session.batches.values())
    _replace_batches(batches, [[group] for batch in batches for group in batch.groups])


def update(*, frame_changed: bool) -> None:
    """Join the groups that moved in this frame and in the frame before to one batch, and separate all others.

    Args:
        frame_changed: whether another frame was evaluated.
    """
    moved_groups: dict[Network, list[PlayerGroup]] = {}
    for group in [group for player_batch in session.batches.values() for group in player_batch.groups]:
        if group.has_moved:
            group.has_moved = False
            moved_groups.setdefault(group.network, []).append(group)
    for player_batch in [batch for batch in session.batches.values() if len(batch.groups) > 1]:
        moved = moved_groups.get(player_batch.network, [])
        if moved and not (frame_changed and set(moved) == set(player_batch.groups)):
            _replace_batches([player_batch], [[group] for group in player_batch.groups])
    for network, groups in moved_groups.items():
        batches = [batch for batch in session.batches.values() if batch.network is network]
        if not frame_changed or len(groups) < MIN_BATCH_SIZE:
            session.moved_groups.pop(network, None)
        elif session.moved_groups.get(network) != set(groups):
            session.moved_groups[network] = set(groups)
        elif all(len(batch.groups) == 1 for batch in batches):
            _replace_batches([batch for batch in batches if batch.groups[0] in groups], [groups])


def _replace_batches(old_batches: Iterable[PlayerBatch], new_groups: Iterable[Sequence[PlayerGroup]]) -> None:
    """Replace batches by batches of other groups. Groups without players are dropped."""
    for player_batch in old_batches:
        session.batches.pop(player_batch.driven_uid)
    objects = {o.session_uid: o for o in bpy.data.objects}
    for groups in new_groups:
        player_batch = PlayerBatch(groups, objects)
        if player_batch.driven_uid:
            session.batches[player_batch.driven_uid] = player_batch
