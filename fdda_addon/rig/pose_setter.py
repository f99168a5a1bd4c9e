# SPDX-License-Identifier: GPL-3.0-or-later
"""Sets poses of a rig and of a target that depends on time, with a pre-roll, or held until the target is at rest."""

import time
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.controls import Control
from ..core.defaults import REPEATABILITY_POSES, REST_THRESHOLD_MM
from ..core.errors import RigError
from ..core.recording.target import FRAMES, POSE, SIMULATION, RecordedTarget
from ..poses.clip import Clip
from ..poses.clip_player import ClipPlayer
from ..scene.arrays import POSE_CHANNELS, write
from ..scene.scene_rig import SceneRig
from ..scene.unit import metres_per_unit
from .target import Target, check_clips, find_target, temporary_frame_range

APPROACH_FRAMES = 10
"""Frames in which the rig moves from the rest pose to a pose that is held."""
MAX_REVERSED_FRAMES = 100
"""Largest number of frames of a clip that are shown in reverse, because the frames before them are played twice."""
MIN_REST_FRAMES = 3
"""Number of consecutive frames without motion that count as rest. A swinging vertex stands still for only one frame at
each turning point."""

PoseFunction = Callable[[float], None]
"""Sets a pose between the rest pose and another pose, given a fraction from 0 to 1."""


@dataclass(frozen=True)
class TargetSettings:
    """Settings of a target.

    Attributes:
        name: name of its object; empty for the rig itself.
        pre_roll: frames before the first frame of an action, in which the rig moves from the rest pose to that frame.
        max_settle_frames: largest number of frames for which a random pose is held until the target is at rest; 0 to
            hold no pose.
        rest_threshold_mm: the target is at rest when no vertex moves by more in a frame, mm.
        repeatability_poses: number of held poses, or frames of actions, that are set a second time, from another
            direction.
    """

    name: str = ""
    pre_roll: int = 0
    max_settle_frames: int = 0
    rest_threshold_mm: float = REST_THRESHOLD_MM
    repeatability_poses: int = REPEATABILITY_POSES


NO_TARGET = TargetSettings()
"""The surface of the rig itself is evaluated."""


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

    def __init__(self, target: Target, max_frames: int, rest_threshold_mm: float = REST_THRESHOLD_MM):
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
            pose: the pose.
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


def show_frames(
    player: ClipPlayer, clip: Clip, frame_indices: Container[int], target: Target | None = None, pre_roll: int = 0
) -> Iterator[int]:
    """Show frames of a clip in their order, one for each iteration.

    If the target is a simulation, all frames from its first frame to the last of `frame_indices` are visited.

    Args:
        player: the player of the clip.
        clip: the clip.
        frame_indices: indices of the frames to yield.
        target: the target; None for the rig itself.
        pre_roll: frames before the first one, in which the rig moves from the rest pose to the first pose.

    Yields:
        The index of the frame in the clip.
    """
    indices = [index for index in range(len(clip.frames)) if index in frame_indices]
    if target is None or not target.simulations or not indices:
        for index in indices:
            player.show(clip, clip.frames[index])
            yield index
        return
    with _started_simulations(player, clip, target, pre_roll):
        for index, frame in enumerate(clip.frames[: indices[-1] + 1]):
            player.show(clip, frame)
            if index in frame_indices:
                yield index


def reversible_frames(clip: Clip) -> range:
    """Return the indices of the frames of a clip that can be shown in reverse: later frames must come before them."""
    return range(min(len(clip.frames) - APPROACH_FRAMES, MAX_REVERSED_FRAMES))


def show_frames_reversed(
    player: ClipPlayer, clip: Clip, frame_indices: Collection[int], target: Target, pre_roll: int = 0
) -> Iterator[int]:
    """Show frames of a clip in reverse: play past the last one, then the poses backwards in later and later frames.

    Args:
        player: the player of the clip.
        clip: the clip.
        frame_indices: indices of the frames to yield, at least one, from `reversible_frames`.
        target: a target with simulations.
        pre_roll: as in `show_frames`.

    Yields:
        The index of the frame in the clip, the last one first.
    """
    turning_index = max(frame_indices) + APPROACH_FRAMES
    with _started_simulations(player, clip, target, pre_roll, extra_frames=turning_index):
        shown_frames = []
        for frame in clip.frames[: turning_index + 1]:
            player.show(clip, frame)
            shown_frames.append(player.current_clip_frame)
        for step, index in enumerate(range(turning_index - 1, min(frame_indices) - 1, -1), 1):
            player.set_clip_frame(shown_frames[index], clip.frames[turning_index] + step)
            if index in frame_indices:
                yield index


@contextmanager
def _started_simulations(
    player: ClipPlayer, clip: Clip, target: Target, pre_roll: int, extra_frames: int = 0
) -> Iterator[None]:
    """Play simulations up to the frame before a clip; inside, they can continue past the end of the clip.

    Args:
        player, clip, target, pre_roll: as in `show_frames`.
        extra_frames: number of frames after the end of the clip.
    """
    first_frame = clip.frames[0] - pre_roll if pre_roll else None
    last_frame = clip.frames[-1] + extra_frames
    needs_range = pre_roll or extra_frames
    with temporary_frame_range(target, first_frame, last_frame) if needs_range else nullcontext():
        if pre_roll:
            _play_pre_roll(target, player, clip, first_frame)
        else:
            target.restart_simulations()
            for frame in range(target.first_frame, clip.frames[0]):
                player.show(clip, frame)
        yield


def _play_pre_roll(target: Target, player: ClipPlayer, clip: Clip, first_frame: int) -> None:
    """Move from the rest pose at a frame towards the first pose of a clip, up to the frame before the clip."""
    armature_object = target.scene_rig.armature_object
    bones = armature_object.pose.bones
    player.show(clip, clip.frames[0])
    end_channels = player.current_clip_frame.channels
    player.stop()
    rest_channels = player.current_clip_frame.channels
    target.restart_simulations()
    for frame in range(first_frame, clip.frames[0]):
        fraction = (frame - first_frame) / (clip.frames[0] - first_frame)
        for channel, start, end in zip(POSE_CHANNELS, rest_channels, end_channels, strict=True):
            write(bones, channel, _interpolate_channel(channel.name, start, end, np.float32(fraction)))
        armature_object.update_tag(refresh={"DATA"})
        bpy.context.scene.frame_set(frame)


def _interpolate_channel(name: str, start: np.ndarray, end: np.ndarray, fraction: np.float32) -> np.ndarray:
    if name == "rotation_quaternion":
        # q and -q are the same rotation; take the nearer one. Blender normalizes quaternions.
        end = np.where((start * end).sum(axis=1, keepdims=True) < 0, -end, end)
    return start + fraction * (end - start)


def blend_from_rest(set_values: Callable[[np.ndarray], None], rest: np.ndarray, values: np.ndarray) -> PoseFunction:
    """Return a function that sets a fraction of a pose.

    Args:
        set_values: sets the values of channels.
        rest: (C,) values of the rest pose.
        values: (C,) values of the pose.
    """

    def set_fraction(fraction: float) -> None:
        set_values(values if fraction == 1 else rest + fraction * (values - rest))

    return set_fraction


class PoseSetter:
    """Sets poses of a rig, or of a target that depends on time.

    Attributes:
        target: the target; None for the rig itself.
        settler: holds the random poses until the target is at rest; None to evaluate them without waiting.
    """

    def __init__(self, target: Target | None = None, pre_roll: int = 0, settler: Settler | None = None):
        """Prepare to set poses.

        Args:
            target, settler: as in the class.
            pre_roll: as in `show_frames`.
        """
        self.target, self.settler = target, settler
        self._pre_roll = pre_roll

    @property
    def recorded_target(self) -> RecordedTarget | None:
        """Return the description of the target in a recording; None without a target."""
        if self.target is None:
            return None
        settling = (self.settler.max_frames, self.settler.rest_threshold_mm) if self.settler else ()
        return RecordedTarget(self.target.name, self.target.follows, self._pre_roll, *settling)

    @contextmanager
    def prepared(self) -> Iterator[None]:
        """Prepare the simulations of the target for random poses; restore them afterwards."""
        with self.settler.prepared() if self.settler else nullcontext():
            yield

    def set_pose(self, pose: PoseFunction) -> None:
        """Set a random pose, and hold it if there is a settler."""
        if self.settler:
            self.settler.settle(pose)
        else:
            pose(1)

    def show_frames(self, player: ClipPlayer, clip: Clip, frame_indices: Container[int]) -> Iterator[int]:
        """Show frames of a clip, as the function `show_frames` does."""
        yield from show_frames(player, clip, frame_indices, self.target, self._pre_roll)

    def show_frames_reversed(self, player: ClipPlayer, clip: Clip, frame_indices: Collection[int]) -> Iterator[int]:
        """Show frames of a clip from the other direction, as the function `show_frames_reversed` does."""
        yield from show_frames_reversed(player, clip, frame_indices, self.target, self._pre_roll)

    @property
    def depends_on_history(self) -> bool:
        """Return whether the surface may depend on earlier poses, not only on the current one."""
        return self.target is not None and bool(self.target.simulations)

    @property
    def is_at_rest(self) -> bool:
        """Return whether the last random pose came to rest, or was not held."""
        return self.settler is None or self.settler.last_rest_state is None or self.settler.last_rest_state.is_at_rest


DIRECT_POSE_SETTER = PoseSetter()
"""Sets poses of a rig, whose surface follows from the pose at once."""


def make_pose_setter(
    scene_rig: SceneRig,
    settings: TargetSettings,
    clips: Sequence[Clip],
    random_pose_count: int,
    controls: Iterable[Control] = (),
) -> PoseSetter:
    """Make the pose setter for a target, and check that the target can be used.

    Args:
        scene_rig: the rig.
        settings: settings of the target.
        clips: the clips whose frames are evaluated.
        random_pose_count: number of random poses.
        controls: the controls of the recording or the model.

    Raises:
        RigError: as `find_target` and `check_clips`, or the target cannot be set to these poses.
    """
    if not settings.name:
        if settings.pre_roll or settings.max_settle_frames:
            raise RigError("A pre-roll and settling need a target; name one, or leave both out.")
        return DIRECT_POSE_SETTER
    target = find_target(scene_rig, settings.name, controls)
    if random_pose_count and target.follows == FRAMES:
        raise RigError(
            f"The target '{target.name}' follows frames ({target.caches[0].description}), so it cannot show random "
            "poses; record 0 random poses, and the action that it was made with."
        )
    if random_pose_count and target.follows == SIMULATION and not settings.max_settle_frames:
        raise RigError(
            f"The target '{target.name}' is a simulation ({target.simulations[0].description}): what it shows in a "
            "random pose depends on the pose before; let it settle, or record 0 of them, and actions."
        )
    if settings.max_settle_frames and (target.follows != SIMULATION or any(not c.is_simulation for c in target.caches)):
        raise RigError(
            f"The target '{target.name}' cannot settle: {_reason_against_settling(target)}; leave settling out."
        )
    if settings.max_settle_frames and clips:
        raise RigError(
            f"Settled poses are random ones, and '{clips[0].name}' is to be recorded too, frame by frame; leave it "
            "out, or make a recording of each."
        )
    check_clips(target, clips, settings.pre_roll)
    settler = (
        Settler(target, settings.max_settle_frames, settings.rest_threshold_mm) if settings.max_settle_frames else None
    )
    return PoseSetter(target, settings.pre_roll, settler)


def _reason_against_settling(target: Target) -> str:
    if target.follows == POSE:
        return "it follows the pose at once"
    cache = next(cache for cache in target.caches if not cache.is_simulation)
    return f"{cache.description} has a fixed range of frames"
