# SPDX-License-Identifier: GPL-3.0-or-later
"""Plans and sets the poses of one or several recordings: random poses, then the frames of clips."""

from collections.abc import Callable, Collection, Container, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np

from ..core.controls import MESH_OBJECT, SHAPE_KEYS
from ..core.mathematics.poses import CONTROL, Channel
from ..poses.clip import Clip
from ..poses.clip_player import ClipPlayer
from ..poses.suspended_limits import SuspendedLimits
from ..rig.pose_setter import DIRECT_POSE_SETTER, PoseSetter, blend_from_rest
from ..rig.shape_keys import set_keys_undriven
from ..rig.simulated_poses import reversible_frames
from ..scene.armature import Poser
from ..scene.scene_rig import SceneRig
from .plan import RecordingSettings, make_pose_sampler, make_recording_margin

REPEATABILITY_INDEX_OFFSET = 1 << 36
"""First index of the random poses from which a pose is approached again to measure the repeatability.

No recording or evaluation has as many poses."""


class PosePlan:
    """Poses that the meshes on one armature share. Channels of a mesh object apply to that mesh alone.

    Attributes:
        total, random_count: number of all poses, and of random poses, which come first.
        in_range_count: number of random poses inside the range of motion; the poses of the margin follow them.
    """

    def __init__(
        self,
        meshes: Sequence[tuple[SceneRig, tuple[Channel, ...]]],
        settings: RecordingSettings,
        clips: tuple[Clip, ...],
        pose_setter: PoseSetter = DIRECT_POSE_SETTER,
    ):
        """Plan the poses.

        Args:
            meshes: the rig of each mesh, and its channels.
            settings: settings of the recording.
            clips: the clips whose frames follow the random poses.
            pose_setter: sets the poses, and waits for a target that depends on time.
        """
        self._rigs = [scene_rig for scene_rig, _ in meshes]
        self._settings, self._clips = settings, clips
        self.pose_setter = pose_setter
        self.random_count = settings.poses
        self.total = settings.poses + sum(len(clip.frames) for clip in clips)
        # A channel that several meshes share has the owner -1, and the first mesh sets it.
        unique_channels: dict[tuple, tuple[int, Channel]] = {}
        for mesh_index, (_, channels) in enumerate(meshes):
            for channel in channels:
                owner_index = mesh_index if _belongs_to_mesh(channel) else -1
                unique_channels.setdefault(
                    (owner_index, channel.name, channel.kind, channel.axis), (owner_index, channel)
                )
        self._owner_indices = np.array([owner_index for owner_index, _ in unique_channels.values()], np.int64)
        self._channels = tuple(channel for _, channel in unique_channels.values())
        self._margin = make_recording_margin(self._rigs[0], settings, self._channels)
        self.in_range_count = settings.poses - (self._margin.poses if self._margin else 0)
        self._sampler = make_pose_sampler(self._rigs[0], settings)

    def channels_of_mesh(self, mesh_index: int) -> tuple[Channel, ...]:
        """Return the channels of the recording of one mesh: the shared channels and its own."""
        is_of_mesh = np.isin(self._owner_indices, (-1, mesh_index))
        return tuple(channel for channel, is_kept in zip(self._channels, is_of_mesh, strict=True) if is_kept)

    def show_poses(self, player: ClipPlayer, pose_indices: Container[int]) -> Iterator[int]:
        """Set the poses with the given indices, one per iteration, and yield each index.

        Limit constraints are disabled while a pose of the margin is set.
        """
        random_count, margin = self.random_count, self._margin
        with self._random_poses_prepared():
            set_pose = self._make_setter(self._channels)
            for index in range(self.in_range_count):
                if index in pose_indices:
                    self.pose_setter.set_pose(self._make_transition(self._channels, index, set_pose))
                    yield index
            if margin:
                set_pose = self._make_setter(margin.channels)
                with SuspendedLimits(self._rigs[0].armature_object, margin.channels) as limits:

                    def set_beyond_range(values: np.ndarray) -> None:
                        set_pose(values)
                        limits.suspend(values)

                    for index in range(self.in_range_count, random_count):
                        if index in pose_indices:
                            self.pose_setter.set_pose(self._make_transition(margin.channels, index, set_beyond_range))
                            yield index
        clip_start = random_count
        for clip in self._clips:
            frame_indices = [index for index in range(len(clip.frames)) if clip_start + index in pose_indices]
            for index in self.pose_setter.show_frames(player, clip, frame_indices):
                yield clip_start + index
            clip_start += len(clip.frames)

    @contextmanager
    def _random_poses_prepared(self) -> Iterator[None]:
        with ExitStack() as stack:
            stack.enter_context(self.pose_setter.prepared())
            for mesh_index, scene_rig in enumerate(self._rigs):
                stack.enter_context(set_keys_undriven(scene_rig, self.channels_of_mesh(mesh_index)))
            yield

    @property
    def repeatable_poses(self) -> list[int]:
        """Return the ascending indices of the poses that `show_poses_again` can set, without poses of the margin."""
        if not self.pose_setter.depends_on_history:
            return []
        if self.pose_setter.is_settling:
            # `make_pose_setter` raises an error for clips if poses settle.
            return list(range(self.in_range_count))
        clip_start, indices = self._settings.poses, []
        for clip in self._clips:
            indices += [clip_start + frame_index for frame_index in reversible_frames(clip)]
            clip_start += len(clip.frames)
        return indices

    def show_poses_again(self, player: ClipPlayer, pose_indices: Collection[int]) -> Iterator[int]:
        """Set poses again from another direction, and yield each index.

        A random pose is reached via another random pose, and a frame of a clip by playing the clip backwards.
        """
        if self.pose_setter.is_settling:
            set_pose = self._make_setter(self._channels)
            with self._random_poses_prepared():
                for index in sorted(pose_indices):
                    sample_indices = (index, REPEATABILITY_INDEX_OFFSET + index)
                    self.pose_setter.set_pose(
                        *(
                            self._make_transition(self._channels, sample_index, set_pose)
                            for sample_index in sample_indices
                        )
                    )
                    yield index
            return
        clip_start = self._settings.poses
        for clip in self._clips:
            if frame_indices := {
                index - clip_start for index in pose_indices if 0 <= index - clip_start < len(clip.frames)
            }:
                for index in self.pose_setter.show_frames_reversed(player, clip, frame_indices):
                    yield clip_start + index
            clip_start += len(clip.frames)

    def _make_transition(
        self, channels: tuple[Channel, ...], index: int, set_pose: Callable[[np.ndarray], None]
    ) -> Callable[[float], None]:
        """Return a function that blends from the rest pose to a random pose by a factor of 0 to 1."""
        is_in_range = index < self.in_range_count or index >= REPEATABILITY_INDEX_OFFSET
        sampler = self._sampler if is_in_range else replace(self._sampler, remix=None)
        return blend_from_rest(set_pose, channels, sampler.draw_pose(channels, index))

    def _make_setter(self, channels: tuple[Channel, ...]) -> Callable[[np.ndarray], None]:
        """Return a function that sets channel values; channels that are not in the plan belong to the armature."""
        owner_indices = np.append(self._owner_indices, np.full(len(channels) - len(self._owner_indices), -1))
        posers_with_indices = [
            (Poser(self._rigs[max(owner_index, 0)], tuple(channels[index] for index in indices)), indices)
            for owner_index in np.unique(owner_indices).tolist()
            for indices in [np.flatnonzero(owner_indices == owner_index)]
        ]

        def set_pose(values: np.ndarray) -> None:
            for poser, indices in posers_with_indices:
                poser.set(values[indices])

        return set_pose


def _belongs_to_mesh(channel: Channel) -> bool:
    """Return whether a channel is a property of the mesh object or of its shape keys."""
    return channel.kind == CONTROL and channel.name.partition("/")[0] in {MESH_OBJECT, SHAPE_KEYS}
