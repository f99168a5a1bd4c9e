# SPDX-License-Identifier: GPL-3.0-or-later
"""The poses of a recording, or of several that share them: random ones, then the frames of clips."""

from collections.abc import Callable, Collection, Container, Iterator, Sequence

import numpy as np

from ..core.controls import MESH_OBJECT, SHAPE_KEYS
from ..core.poses import CONTROL, Channel, sample_pose
from ..poses.clip import Clip
from ..poses.clip_player import ClipPlayer
from ..poses.suspended_limits import SuspendedLimits
from ..rig.pose_setter import DIRECT_POSE_SETTER, PoseSetter, blend_from_rest, reversible_frames
from ..scene.armature import Poser
from ..scene.scene_rig import SceneRig
from .plan import RecordingSettings, make_recording_margin

REPEAT_INDEX = 1 << 36
"""Poses that are passed through are drawn from indices that neither a recording nor an evaluation reaches."""


class PosePlan:
    """Poses that meshes on one armature have in common; each mesh has the numbers of its own object to itself.

    Attributes:
        total: number of poses.
        inside: how many random poses are within the range of motion, the first; those of a margin follow.
    """

    def __init__(
        self,
        meshes: Sequence[tuple[SceneRig, tuple[Channel, ...]]],
        settings: RecordingSettings,
        clips: tuple[Clip, ...],
        pose_setter: PoseSetter = DIRECT_POSE_SETTER,
    ):
        """Args:
        meshes: each with the channels that move it.
        settings: of the recording.
        clips: whose frames follow.
        pose_setter: how a target that depends on time is brought to the poses.
        """
        self._rigs = [scene_rig for scene_rig, _ in meshes]
        self._settings, self._clips = settings, clips
        self.pose_setter = pose_setter
        self.total = settings.poses + sum(len(clip.frames) for clip in clips)
        # The first mesh moves what all have in common.
        found: dict[tuple, tuple[int, Channel]] = {}
        for number, (_, channels) in enumerate(meshes):
            for channel in channels:
                own = number if _is_of_mesh(channel) else -1
                found.setdefault((own, channel.name, channel.kind, channel.axis), (own, channel))
        self._owners = np.array([own for own, _ in found.values()], np.int64)
        self._channels = tuple(channel for _, channel in found.values())
        self._margin = make_recording_margin(self._rigs[0], settings, self._channels)
        self.inside = settings.poses - (self._margin.poses if self._margin else 0)

    def channels_of(self, number: int) -> tuple[Channel, ...]:
        """The channels of the poses as the recording of a mesh has them: without those of other meshes."""
        own = np.isin(self._owners, (-1, number))
        return tuple(channel for channel, is_own in zip(self._channels, own, strict=True) if is_own)

    def poses(self, player: ClipPlayer, wanted: Container[int]) -> Iterator[int]:
        """Pose the rigs, one pose an iteration, in the poses that are wanted, by their numbers; yields the number.

        Limit constraints that would hold a pose of the margin are off while it is shown.
        """
        poses, margin = self._settings.poses, self._margin
        with self.pose_setter.prepared():
            set_pose = self._setter(self._channels)
            for index in range(self.inside):
                if index in wanted:
                    self.pose_setter.set_pose(self._way_to(self._channels, index, set_pose))
                    yield index
            if margin:
                set_pose = self._setter(margin.channels)
                with SuspendedLimits(self._rigs[0].armature_object, margin.channels) as limits:

                    def set_beyond(values: np.ndarray) -> None:
                        set_pose(values)
                        limits.suspend(values)

                    for index in range(self.inside, poses):
                        if index in wanted:
                            self.pose_setter.set_pose(self._way_to(margin.channels, index, set_beyond))
                            yield index
        first = poses
        for clip in self._clips:
            own = [number for number in range(len(clip.frames)) if first + number in wanted]
            for number in self.pose_setter.show_frames(player, clip, own):
                yield first + number
            first += len(clip.frames)

    @property
    def repeatable(self) -> list[int]:
        """Numbers of the poses that `poses_again` may reach, ascending; those of a margin are not among them."""
        if not self.pose_setter.depends_on_history:
            return []
        if self.pose_setter.settler:
            # There are no frames of clips (`make_pose_setter`).
            return list(range(self.inside))
        first, numbers = self._settings.poses, []
        for clip in self._clips:
            numbers += [first + number for number in reversible_frames(clip)]
            first += len(clip.frames)
        return numbers

    def poses_again(self, player: ClipPlayer, wanted: Collection[int]) -> Iterator[int]:
        """As `poses`, over another way: random poses over one that no recording of this plan has, and frames of clips
        from those that follow them."""
        if self.pose_setter.settler:
            set_pose = self._setter(self._channels)
            with self.pose_setter.prepared():
                for index in sorted(wanted):
                    numbers = (index, REPEAT_INDEX + index)
                    self.pose_setter.settler.settle(*(self._way_to(self._channels, n, set_pose) for n in numbers))
                    yield index
            return
        first = self._settings.poses
        for clip in self._clips:
            if own := {number - first for number in wanted if 0 <= number - first < len(clip.frames)}:
                for number in self.pose_setter.show_frames_reversed(player, clip, own):
                    yield first + number
            first += len(clip.frames)

    def _way_to(
        self, channels: tuple[Channel, ...], index: int, set_pose: Callable[[np.ndarray], None]
    ) -> Callable[[float], None]:
        """Sets what part of the way from the rest pose to a random pose is done, 0 to 1."""
        values = sample_pose(channels, self._settings.seed, index, self._settings.spread)
        return blend_from_rest(set_pose, np.array([channel.rest for channel in channels]), values)

    def _setter(self, channels: tuple[Channel, ...]) -> Callable[[np.ndarray], None]:
        """What poses the rigs, of channels that begin with those of the plan; what follows is of the armature."""
        owners = np.append(self._owners, np.full(len(channels) - len(self._owners), -1))
        posers = [
            (Poser(self._rigs[max(own, 0)], tuple(channels[place] for place in places)), places)
            for own in np.unique(owners).tolist()
            for places in [np.flatnonzero(owners == own)]
        ]

        def set_pose(values: np.ndarray) -> None:
            for poser, places in posers:
                poser.set(values[places])

        return set_pose


def _is_of_mesh(channel: Channel) -> bool:
    """Whether a channel is a number of the mesh object or of its shape keys, which have one name for every mesh."""
    return channel.kind == CONTROL and channel.name.partition("/")[0] in {MESH_OBJECT, SHAPE_KEYS}
