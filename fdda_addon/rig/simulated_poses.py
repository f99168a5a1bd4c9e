# SPDX-License-Identifier: GPL-3.0-or-later
"""Sets poses of a simulated target: with a pre-roll before actions, and held until the target is at rest."""

import time
from collections.abc import Collection, Container, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace

import bpy
import numpy as np

from ..core.recording.target import RecordedTarget
from ..core.settings import REST_THRESHOLD_MM
from ..poses.clip import Clip
from ..poses.clip_player import ClipPlayer
from ..scene.arrays import POSE_CHANNELS, write
from ..scene.unit import metres_per_unit
from .pose_setter import PoseFunction, PoseSetter
from .target import Target, temporary_frame_range

APPROACH_FRAMES = 10
"""Frames in which the rig moves from the rest pose to a pose that is held."""
MAX_REVERSED_FRAMES = 100
"""Largest number of frames of a clip that are shown in reverse, because the frames before them are played twice."""
MIN_REST_FRAMES = 3
"""Number of consecutive frames without motion that count as rest. A swinging vertex stands still for only one frame at
each turning point."""


@dataclass(frozen=True)
class RestState:
    """How a target came to rest in a pose.

    Attributes:
        held_frame_count: number of frames for which the pose was held.
        speed_mm: speed of the fastest vertex in the last frame, mm per frame.
        is_at_rest: the target came to rest.
        seconds: time that the evaluation of these frames took.
    """

    held_frame_count: int
    speed_mm: float
    is_at_rest: bool
    seconds: float

    def __str__(self) -> str:
        duration = f"{self.held_frame_count} frames, {self.seconds:.1f} s"
        return duration if self.is_at_rest else f"not at rest after {duration}: {self.speed_mm:.2g} mm per frame"


class Settler:
    """Holds poses until a simulated target is at rest, so that its surface depends on the pose alone.

    Attributes:
        max_frames: largest number of frames for which a pose is held.
        rest_threshold_mm: the target is at rest when no vertex moves by more in a frame, mm.
        last_rest_state: the rest state of the last pose; None before the first pose.
    """

    def __init__(self, target: Target, max_frames: int, rest_threshold_mm: float = REST_THRESHOLD_MM.default):
        """Prepare to settle a target.

        Args:
            target: a target with simulations.
            max_frames, rest_threshold_mm: as above.
        """
        self._target, self.max_frames, self.rest_threshold_mm = target, max_frames, rest_threshold_mm
        self._mm_per_unit = 1000 * metres_per_unit(target.scene_rig.mesh_object)
        self._first_frame = target.first_frame
        self.last_rest_state: RestState | None = None

    @contextmanager
    def prepared(self) -> Iterator[None]:
        """Extend the simulations of the target to the frames that `settle` needs; restore them afterwards."""
        last_frame = self._first_frame + 2 * APPROACH_FRAMES + self.max_frames
        with temporary_frame_range(self._target, self._first_frame, last_frame):
            yield

    def settle(self, pose: PoseFunction, via_pose: PoseFunction | None = None) -> RestState:
        """Move from the rest pose to a pose, and hold it until the target is at rest, for at most `max_frames` frames.

        Args:
            via_pose: another pose through which the rig moves on the way.
        """
        start_time, scene, frame = time.perf_counter(), bpy.context.scene, self._first_frame
        self._target.restart_simulations()
        all_steps, later_steps = range(APPROACH_FRAMES + 1), range(1, APPROACH_FRAMES + 1)
        movements = [(via_pose, all_steps), (pose, later_steps)] if via_pose else [(pose, all_steps)]
        for set_fraction, steps in movements:
            for step in steps:
                set_fraction(step / APPROACH_FRAMES)
                scene.frame_set(frame)
                frame += 1
        previous_positions, rest_frame_count, held_frame_count, speed_mm = self._positions(), 0, 0, 0.0
        while held_frame_count < self.max_frames and rest_frame_count < MIN_REST_FRAMES:
            scene.frame_set(frame + held_frame_count)
            current_positions = self._positions()
            offsets = current_positions - previous_positions
            speed_mm = float(np.sqrt(np.einsum("vc,vc->v", offsets, offsets).max())) * self._mm_per_unit
            previous_positions, held_frame_count = current_positions, held_frame_count + 1
            rest_frame_count = rest_frame_count + 1 if speed_mm <= self.rest_threshold_mm else 0
        self.last_rest_state = RestState(
            held_frame_count, speed_mm, rest_frame_count >= MIN_REST_FRAMES, time.perf_counter() - start_time
        )
        return self.last_rest_state

    def _positions(self) -> np.ndarray:
        return self._target.positions(bpy.context.evaluated_depsgraph_get())


def reversible_frames(clip: Clip) -> range:
    """Return the indices of the frames of a clip that can be shown in reverse: later frames must come before them."""
    return range(min(len(clip.frames) - APPROACH_FRAMES, MAX_REVERSED_FRAMES))


class SimulatedPoseSetter(PoseSetter):
    """Sets poses of a target with simulations, whose surface depends on earlier poses."""

    def __init__(self, target: Target, pre_roll: int = 0, settler: Settler | None = None):
        """Prepare to set poses.

        Args:
            target, pre_roll: as in `PoseSetter`.
            settler: holds the random poses until the target is at rest; None if there are only frames of clips.
        """
        super().__init__(target, pre_roll)
        self._settler = settler

    @property
    def recorded_target(self) -> RecordedTarget:
        description = super().recorded_target
        if self._settler is None:
            return description
        settling = {"settle_frames": self._settler.max_frames, "rest_threshold_mm": self._settler.rest_threshold_mm}
        return replace(description, **settling)

    @property
    def depends_on_history(self) -> bool:
        return True

    @property
    def is_settling(self) -> bool:
        return self._settler is not None

    @property
    def _rest_state(self) -> RestState | None:
        return self._settler.last_rest_state if self._settler else None

    @property
    def is_at_rest(self) -> bool:
        return self._rest_state is None or self._rest_state.is_at_rest

    @property
    def rest_description(self) -> str:
        return str(self._rest_state) if self._settler else ""

    @property
    def seconds_per_pose(self) -> float | None:
        return self._rest_state.seconds if self._rest_state else None

    @contextmanager
    def prepared(self) -> Iterator[None]:
        with self._settler.prepared() if self._settler else nullcontext():
            yield

    def set_pose(self, pose: PoseFunction, via_pose: PoseFunction | None = None) -> None:
        if self._settler:
            self._settler.settle(pose, via_pose)
        else:
            pose(1)

    def show_frames(self, player: ClipPlayer, clip: Clip, frame_indices: Container[int]) -> Iterator[int]:
        """Show frames of a clip as `PoseSetter` does, and visit all frames up to the last of `frame_indices`."""
        indices = [index for index in range(len(clip.frames)) if index in frame_indices]
        if not indices:
            return
        with self._started_simulations(player, clip):
            for index, frame in enumerate(clip.frames[: indices[-1] + 1]):
                player.show(clip, frame)
                if index in frame_indices:
                    yield index

    def show_frames_reversed(self, player: ClipPlayer, clip: Clip, frame_indices: Collection[int]) -> Iterator[int]:
        """Show frames of a clip in reverse: play past the last one, then the poses backwards in later and later frames.

        Args:
            player: the player of the clip.
            frame_indices: indices of the frames to yield, at least one, from `reversible_frames`.

        Yields:
            The index of the frame in the clip, the last one first.
        """
        turning_index = max(frame_indices) + APPROACH_FRAMES
        with self._started_simulations(player, clip, extra_frames=turning_index):
            shown_frames = []
            for frame in clip.frames[: turning_index + 1]:
                player.show(clip, frame)
                shown_frames.append(player.current_clip_frame)
            for step, index in enumerate(range(turning_index - 1, min(frame_indices) - 1, -1), 1):
                player.set_clip_frame(shown_frames[index], clip.frames[turning_index] + step)
                if index in frame_indices:
                    yield index

    @contextmanager
    def _started_simulations(self, player: ClipPlayer, clip: Clip, extra_frames: int = 0) -> Iterator[None]:
        """Play simulations up to the frame before a clip; inside, they can continue past the end of the clip."""
        first_frame = clip.frames[0] - self._pre_roll if self._pre_roll else None
        last_frame = clip.frames[-1] + extra_frames
        needs_range = self._pre_roll or extra_frames
        with temporary_frame_range(self.target, first_frame, last_frame) if needs_range else nullcontext():
            if self._pre_roll:
                # Move from the rest pose towards the first pose of the clip, up to the frame before the clip.
                player.show(clip, clip.frames[0])
                end_channels = player.current_clip_frame.channels
                player.stop()
                rest_channels = player.current_clip_frame.channels
                self.target.restart_simulations()
                for frame in range(first_frame, clip.frames[0]):
                    fraction = (frame - first_frame) / (clip.frames[0] - first_frame)
                    for armature_object in player.armature_objects:
                        ends = rest_channels[armature_object], end_channels[armature_object]
                        for channel, start, end in zip(POSE_CHANNELS, *ends, strict=True):
                            values = _interpolate_channel(channel.name, start, end, np.float32(fraction))
                            write(armature_object.pose.bones, channel, values)
                        armature_object.update_tag(refresh={"DATA"})
                    bpy.context.scene.frame_set(frame)
            else:
                self.target.restart_simulations()
                for frame in range(self.target.first_frame, clip.frames[0]):
                    player.show(clip, frame)
            yield


def _interpolate_channel(name: str, start: np.ndarray, end: np.ndarray, fraction: np.float32) -> np.ndarray:
    if name == "rotation_quaternion":
        # q and -q are the same rotation; take the nearer one. Blender normalizes quaternions.
        end = np.where((start * end).sum(axis=1, keepdims=True) < 0, -end, end)
    return start + fraction * (end - start)
