# SPDX-License-Identifier: GPL-3.0-or-later
"""The poses of a recording, or of several that share them: random ones, then the frames of clips."""

from collections.abc import Container, Iterator, Sequence

import numpy as np

from ..core.controls import MESH_OBJECT, SHAPE_KEYS
from ..core.poses import CONTROL, Channel, sample_pose
from ..poses.clip import Clip
from ..poses.clip_player import ClipPlayer
from ..scene.armature import Poser
from ..scene.scene_rig import SceneRig


class PosePlan:
    """Poses that meshes on one armature have in common; each mesh has the numbers of its own object to itself.

    Attributes:
        total: number of poses.
    """

    def __init__(
        self,
        meshes: Sequence[tuple[SceneRig, tuple[Channel, ...]]],
        poses: int,
        seed: int,
        spread: float,
        clips: tuple[Clip, ...],
    ):
        """Args:
        meshes: each with the channels that move it.
        poses, seed, spread: of the random poses, as in `RecordingSettings`.
        clips: whose frames follow.
        """
        self._rigs = [scene_rig for scene_rig, _ in meshes]
        self._poses, self._seed, self._spread, self._clips = poses, seed, spread, clips
        self.total = poses + sum(len(clip.frames) for clip in clips)
        # The first mesh moves what all have in common.
        found: dict[tuple, tuple[int, Channel]] = {}
        for number, (_, channels) in enumerate(meshes):
            for channel in channels:
                own = number if _is_of_mesh(channel) else -1
                found.setdefault((own, channel.name, channel.kind, channel.axis), (own, channel))
        self._owners = np.array([own for own, _ in found.values()], np.int64)
        self._channels = tuple(channel for _, channel in found.values())

    def channels_of(self, number: int) -> tuple[Channel, ...]:
        """The channels of the poses as the recording of a mesh has them: without those of other meshes."""
        own = np.isin(self._owners, (-1, number))
        return tuple(channel for channel, is_own in zip(self._channels, own, strict=True) if is_own)

    def poses(self, player: ClipPlayer, wanted: Container[int]) -> Iterator[int]:
        """Pose the rigs, one pose an iteration, in the poses that are wanted, by their numbers; yields the number."""
        posers = [
            (Poser(self._rigs[max(own, 0)], tuple(self._channels[place] for place in places)), places)
            for own in np.unique(self._owners).tolist()
            for places in [np.flatnonzero(self._owners == own)]
        ]
        for index in range(self._poses):
            if index in wanted:
                values = sample_pose(self._channels, self._seed, index, self._spread)
                for poser, places in posers:
                    poser.set(values[places])
                yield index
        frames = ((clip, frame) for clip in self._clips for frame in clip.frames)
        for index, (clip, frame) in enumerate(frames, self._poses):
            if index in wanted:
                player.show(clip, frame)
                yield index


def _is_of_mesh(channel: Channel) -> bool:
    """Whether a channel is a number of the mesh object or of its shape keys, which have one name for every mesh."""
    return channel.kind == CONTROL and channel.name.partition("/")[0] in {MESH_OBJECT, SHAPE_KEYS}
