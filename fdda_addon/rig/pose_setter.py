# SPDX-License-Identifier: GPL-3.0-or-later
"""Brings a target that depends on time to poses: frames in their order with a pre-roll, poses held until it rests."""

import time
from collections.abc import Callable, Collection, Container, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

import bpy
import numpy as np

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
"""Frames in which a pose is approached that is held afterwards."""
MAX_REVERSED_FRAMES = 100
"""Frames of a clip beyond so many are not shown from the other side: all that are before them are played twice."""
REST_FRAMES = 3
"""So many frames in a row no vertex may move: what swings stands still for one at each turn."""


@dataclass(frozen=True)
class TargetSettings:
    """Which target is evaluated, and how.

    Attributes:
        name: of its object; empty for the rig itself.
        pre_roll: frames before the first of an action, in which the rig goes from the rest pose to it.
        max_settle_frames: most frames for which a random pose is held until the target is at rest; 0 does not hold it.
        rest_threshold_mm: it is at rest when no vertex moves by more from a frame to the next, mm.
        repeatability_poses: how many poses that are held, or frames of actions, are reached a second time, from another
            direction.
    """

    name: str = ""
    pre_roll: int = 0
    max_settle_frames: int = 0
    rest_threshold_mm: float = REST_THRESHOLD_MM
    repeatability_poses: int = REPEATABILITY_POSES


NO_TARGET = TargetSettings()
"""No target: the rig is evaluated itself."""


@dataclass(frozen=True)
class RestState:
    """Whether a target came to rest in a pose, and after how long.

    Attributes:
        frames: for which the pose was held.
        speed_mm: of the fastest vertex in the last of them, mm a frame.
        is_at_rest: it came to rest.
        seconds: that all of it took.
    """

    frames: int
    speed_mm: float
    is_at_rest: bool
    seconds: float

    def __str__(self) -> str:
        what = f"{self.frames} frames, {self.seconds:.1f} s"
        return what if self.is_at_rest else f"not at rest after {what}: {self.speed_mm:.2g} mm a frame"


class Settler:
    """Holds poses until a target has come to rest: what it shows depends on the pose alone then.

    Attributes:
        frames: for which a pose is held at most.
        rest_threshold_mm: the target is at rest when no vertex moves by more from a frame to the next, mm.
        last: how the last pose came to rest, None before the first.
    """

    def __init__(self, target: Target, frames: int, rest_threshold_mm: float = REST_THRESHOLD_MM):
        """Args:
        target: a simulation.
        frames, rest_threshold_mm: as above.
        """
        self._target, self.frames, self.rest_threshold_mm = target, frames, rest_threshold_mm
        self._mm_per_unit = 1000 * metres_per_unit(target.scene_rig.mesh_object)
        self._first = target.first_frame
        self.last: RestState | None = None

    @contextmanager
    def prepared(self) -> Iterator[None]:
        """Let the simulations of the target last for as long as it takes; poses are settled inside."""
        with temporary_frame_range(self._target, self._first, self._first + 2 * APPROACH_FRAMES + self.frames):
            yield

    def settle(self, pose: Callable[[float], None], over: Callable[[float], None] | None = None) -> RestState:
        """Go from the rest pose to a pose, and hold it until the target rests or the frames are over.

        Args:
            pose: sets what part of the way from the rest pose is done, 0 to 1.
            over: the same of another pose, which is passed through on the way.
        """
        start, scene, frame = time.perf_counter(), bpy.context.scene, self._first
        self._target.restart_simulations()
        ways = (
            [(over, range(APPROACH_FRAMES + 1)), (pose, range(1, APPROACH_FRAMES + 1))]
            if over
            else [(pose, range(APPROACH_FRAMES + 1))]
        )
        for way, steps in ways:
            for step in steps:
                way(step / APPROACH_FRAMES)
                scene.frame_set(frame)
                frame += 1
        before, quiet, held, speed = self._positions(), 0, 0, 0.0
        while held < self.frames and quiet < REST_FRAMES:
            scene.frame_set(frame + held)
            now = self._positions()
            speed = float(np.sqrt(np.einsum("vc,vc->v", now - before, now - before).max())) * self._mm_per_unit
            before, held = now, held + 1
            quiet = quiet + 1 if speed <= self.rest_threshold_mm else 0
        self.last = RestState(held, speed, quiet >= REST_FRAMES, time.perf_counter() - start)
        return self.last

    def _positions(self) -> np.ndarray:
        return self._target.positions(bpy.context.evaluated_depsgraph_get())


def show_frames(
    player: ClipPlayer, clip: Clip, wanted: Container[int], target: Target | None = None, pre_roll: int = 0
) -> Iterator[int]:
    """Show frames of a clip, one an iteration, in their order; yields their numbers in the clip.

    Where the target is a simulation, all frames from its first on are visited, until the last that is wanted.

    Args:
        player: plays the clip.
        clip: the clip.
        wanted: numbers of the frames that are yielded.
        target: what is evaluated; None for the rig itself.
        pre_roll: frames before the first, in which the rig goes from the rest pose to that of the first.
    """
    numbers = [number for number in range(len(clip.frames)) if number in wanted]
    if target is None or not target.simulations or not numbers:
        for number in numbers:
            player.show(clip, clip.frames[number])
            yield number
        return
    with _begun(player, clip, target, pre_roll):
        for number, frame in enumerate(clip.frames[: numbers[-1] + 1]):
            player.show(clip, frame)
            if number in wanted:
                yield number


def reversible_frames(clip: Clip) -> range:
    """Numbers of the frames of a clip that can be shown from the other side: there are some to come back from."""
    return range(min(len(clip.frames) - APPROACH_FRAMES, MAX_REVERSED_FRAMES))


def show_frames_reversed(
    player: ClipPlayer, clip: Clip, wanted: Collection[int], target: Target, pre_roll: int = 0
) -> Iterator[int]:
    """Show frames of a clip from the other side: it is played past the last, and back to the first, as time goes on.

    Args:
        player: plays the clip.
        clip: the clip.
        wanted: numbers of the frames that are yielded, at least one, each of `reversible_frames`.
        target: a simulation.
        pre_roll: as in `show_frames`.

    Yields:
        Their numbers in the clip, the last one first.
    """
    turn = max(wanted) + APPROACH_FRAMES
    with _begun(player, clip, target, pre_roll, beyond=turn):
        ways = []
        for frame in clip.frames[: turn + 1]:
            player.show(clip, frame)
            ways.append(player.shown)
        for step, number in enumerate(range(turn - 1, min(wanted) - 1, -1), 1):
            player.put(ways[number], clip.frames[turn] + step)
            if number in wanted:
                yield number


@contextmanager
def _begun(player: ClipPlayer, clip: Clip, target: Target, pre_roll: int, beyond: int = 0) -> Iterator[None]:
    """A simulation is at the frame before the first of a clip, and goes on until so many frames beyond its last."""
    first, last = (clip.frames[0] - pre_roll if pre_roll else None), clip.frames[-1] + beyond
    with temporary_frame_range(target, first, last) if pre_roll or beyond else nullcontext():
        if pre_roll:
            _roll_in(target, player, clip, first)
        else:
            target.restart_simulations()
            for frame in range(target.first_frame, clip.frames[0]):
                player.show(clip, frame)
        yield


def _roll_in(target: Target, player: ClipPlayer, clip: Clip, first: int) -> None:
    """Go from the rest pose, at a frame, to the pose of the first frame of a clip, up to the frame before it."""
    armature_object = target.scene_rig.armature_object
    bones = armature_object.pose.bones
    player.show(clip, clip.frames[0])
    goal = player.shown.channels
    player.stop()
    rest = player.shown.channels
    target.restart_simulations()
    for frame in range(first, clip.frames[0]):
        part = (frame - first) / (clip.frames[0] - first)
        for channel, start, end in zip(POSE_CHANNELS, rest, goal, strict=True):
            write(bones, channel, _between(channel.name, start, end, np.float32(part)))
        armature_object.update_tag(refresh={"DATA"})
        bpy.context.scene.frame_set(frame)


def _between(name: str, start: np.ndarray, end: np.ndarray, part: np.float32) -> np.ndarray:
    if name == "rotation_quaternion":
        # The shorter way; Blender normalizes.
        end = np.where((start * end).sum(axis=1, keepdims=True) < 0, -end, end)
    return start + part * (end - start)


def blend_from_rest(
    set_values: Callable[[np.ndarray], None], rest: np.ndarray, values: np.ndarray
) -> Callable[[float], None]:
    """Sets what part of the way from values (C,) of the rest pose to those of a pose is done, 0 to 1."""

    def pose(part: float) -> None:
        set_values(values if part == 1 else rest + part * (values - rest))

    return pose


class PoseSetter:
    """How a rig, or a target, is brought to poses.

    Attributes:
        target: what is evaluated; None for the rig itself.
        settler: holds the random poses; None where they are evaluated at once.
    """

    def __init__(self, target: Target | None = None, pre_roll: int = 0, settler: Settler | None = None):
        """Args:
        target, settler: as above.
        pre_roll: as in `show_frames`.
        """
        self.target, self.settler = target, settler
        self._pre_roll = pre_roll

    @property
    def recorded(self) -> RecordedTarget | None:
        """What a recording says of the target."""
        if self.target is None:
            return None
        held = (self.settler.frames, self.settler.rest_threshold_mm) if self.settler else ()
        return RecordedTarget(self.target.name, self.target.follows, self._pre_roll, *held)

    @contextmanager
    def prepared(self) -> Iterator[None]:
        """Random poses are reached inside."""
        with self.settler.prepared() if self.settler else nullcontext():
            yield

    def set_pose(self, pose: Callable[[float], None]) -> None:
        """Bring it to a random pose; `pose` sets what part of the way from the rest pose is done, 0 to 1."""
        if self.settler:
            self.settler.settle(pose)
        else:
            pose(1)

    def show_frames(self, player: ClipPlayer, clip: Clip, wanted: Container[int]) -> Iterator[int]:
        """As `show_frames`."""
        yield from show_frames(player, clip, wanted, self.target, self._pre_roll)

    def show_frames_reversed(self, player: ClipPlayer, clip: Clip, wanted: Collection[int]) -> Iterator[int]:
        """As `show_frames_reversed`."""
        yield from show_frames_reversed(player, clip, wanted, self.target, self._pre_roll)

    @property
    def depends_on_history(self) -> bool:
        """Whether what is shown may depend on the way to a pose, and not on the pose alone."""
        return self.target is not None and bool(self.target.simulations)

    @property
    def is_at_rest(self) -> bool:
        """Whether the last random pose came to rest, or was not held."""
        return self.settler is None or self.settler.last is None or self.settler.last.is_at_rest


DIRECT_POSE_SETTER = PoseSetter()
"""Of a rig, which follows from its pose at once."""


def make_pose_setter(scene_rig: SceneRig, settings: TargetSettings, clips: Sequence[Clip], random: int) -> PoseSetter:
    """How poses are reached with these settings; all that can be refused is refused.

    Args:
        scene_rig: the rig.
        settings: of the target.
        clips: whose frames are evaluated.
        random: how many random poses are.

    Raises:
        RigError: as `find_target` and `check_clips`, or the target cannot be brought to these poses.
    """
    if not settings.name:
        if settings.pre_roll or settings.max_settle_frames:
            raise RigError(
                "There is no target whose time a pre-roll or settling would change; give one, or none of both."
            )
        return DIRECT_POSE_SETTER
    target = find_target(scene_rig, settings.name)
    if random and target.follows == FRAMES:
        raise RigError(
            f"The target '{target.name}' shows frames ({target.caches[0].words}), and not random poses; record 0 of "
            "them, and the action that it was made with."
        )
    if random and target.follows == SIMULATION and not settings.max_settle_frames:
        raise RigError(
            f"The target '{target.name}' is a simulation ({target.simulations[0].words}): what it shows in a random "
            "pose depends on the pose before; let it settle, or record 0 of them, and actions."
        )
    if settings.max_settle_frames and (target.follows != SIMULATION or any(not c.is_simulation for c in target.caches)):
        raise RigError(f"The target '{target.name}' cannot settle: {_why_not(target)}; leave settling out.")
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


def _why_not(target: Target) -> str:
    if target.follows == POSE:
        return "it follows the pose at once"
    cache = next(cache for cache in target.caches if not cache.is_simulation)
    return f"{cache.words} has the frames that it has"
