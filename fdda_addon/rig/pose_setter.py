# SPDX-License-Identifier: GPL-3.0-or-later
"""Prepares a rig for posing, and sets poses of it, or of a target, which may be simulated.

A simulation gets a pre-roll before actions, and random poses are held until it is at rest.
"""

import time
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.controls import Control
from ..core.errors import RigError
from ..core.mathematics.poses import CONTROL, Channel
from ..core.recording.index import FRAMES, SIMULATION, RecordedTarget
from ..core.rig import Rig
from ..core.settings import LEARN_FROM, PRE_ROLL, REST_THRESHOLD_MM, SETTLE_FRAMES
from ..poses.clip import Clip
from ..poses.clip_player import ClipPlayer, clip_player
from ..scene.arrays import POSE_CHANNELS, write
from ..scene.comparison import hidden_comparison_objects
from ..scene.controls import temporary_controls
from ..scene.scene_rig import SceneRig
from ..scene.time_stretching import unstretched_time
from ..scene.unit import metres_per_unit
from .modifier_stack import downstream_disabled
from .target import Target, check_clips, find_target, temporary_frame_range

PoseFunction = Callable[[float], None]
"""Sets a pose between the rest pose and another pose, given a fraction from 0 to 1."""


@dataclass(frozen=True)
class TargetSettings:
    """Settings of a target.

    Attributes:
        name: name of its object; empty for the rig itself.
        pre_roll: frames before the first frame of an action, in which the rig moves from the rest pose to that frame.
        settle_frames: largest number of frames for which a random pose is held until the target is at rest; 0 to
            hold no pose.
        rest_threshold_mm: the target is at rest when no vertex moves by more in a frame, mm.
    """

    name: str = LEARN_FROM.default
    pre_roll: int = PRE_ROLL.field()
    settle_frames: int = SETTLE_FRAMES.field()
    rest_threshold_mm: float = REST_THRESHOLD_MM.field()


NO_TARGET = TargetSettings()
"""The surface of the rig itself is evaluated."""


def blend_from_rest(
    set_values: Callable[[np.ndarray], None], channels: Sequence[Channel], values: np.ndarray
) -> PoseFunction:
    """Return a function that sets a fraction of a pose.

    Args:
        set_values: sets the values of the channels.
        channels: C channels.
        values: (C,) values of the pose.
    """

    def set_fraction(fraction: float) -> None:
        if fraction == 1:
            set_values(values)
        else:
            rest = np.array([channel.rest for channel in channels])
            set_values(rest + fraction * (values - rest))

    return set_fraction


APPROACH_FRAMES = 10
"""Frames in which the rig moves from the rest pose to a pose that is held."""
MIN_REST_FRAMES = 3
"""Number of consecutive frames without motion that count as rest. A swinging vertex stands still for only one frame at
each turning point."""


class PoseSetter:
    """Sets poses of a rig, or of a target, whose surface may depend on earlier poses.

    Attributes:
        target: the target; None for the rig itself.
        depends_on_history: the target has simulations, so its surface may depend on earlier poses.
        is_settling: random poses are held until the target is at rest, so that its surface depends on the pose alone.
        is_at_rest: the last random pose came to rest, or was not held.
        rest_description: how the target came to rest in the last random pose; empty if poses are not held.
        seconds_per_pose: the time that the last random pose took to settle; None if none was held.
    """

    def __init__(self, target: Target | None = None, settings: TargetSettings = NO_TARGET):
        """Prepare to set poses.

        Args:
            target: as in the class.
            settings: settings of the target.
        """
        self.target, self._settings = target, settings
        self.depends_on_history = target is not None and bool(target.simulations)
        self.is_settling = settings.settle_frames > 0
        self.is_at_rest, self.rest_description = True, ""
        self.seconds_per_pose: float | None = None

    @property
    def recorded_target(self) -> RecordedTarget | None:
        """Return the description of the target in a recording; None without a target."""
        settings = self._settings
        settling = (settings.settle_frames, settings.rest_threshold_mm) if self.is_settling else ()
        return (
            RecordedTarget(self.target.name, self.target.follows, settings.pre_roll, *settling) if self.target else None
        )

    @contextmanager
    def prepared(self) -> Iterator[None]:
        """Extend the simulations of the target to the frames that held poses need; restore them afterwards."""
        if not self.is_settling:
            yield
            return
        last_frame = self.target.first_frame + 2 * APPROACH_FRAMES + self._settings.settle_frames
        with temporary_frame_range(self.target, self.target.first_frame, last_frame):
            yield

    def set_pose(self, pose: PoseFunction, via_pose: PoseFunction | None = None) -> None:
        """Set a random pose. If poses settle, move from the rest pose to it, and hold it until the target is at rest.

        Args:
            pose: sets the pose.
            via_pose: sets another pose, through which the rig moves on the way if poses settle.
        """
        if not self.is_settling:
            pose(1)
            return
        start_time, scene, frame = time.perf_counter(), bpy.context.scene, self.target.first_frame
        mm_per_unit = 1000 * metres_per_unit(self.target.scene_rig.mesh_object)
        self.target.restart_simulations()
        all_steps, later_steps = range(APPROACH_FRAMES + 1), range(1, APPROACH_FRAMES + 1)
        movements = [(via_pose, all_steps), (pose, later_steps)] if via_pose else [(pose, all_steps)]
        for set_fraction, steps in movements:
            for step in steps:
                set_fraction(step / APPROACH_FRAMES)
                scene.frame_set(frame)
                frame += 1
        previous_positions = self.target.positions(bpy.context.evaluated_depsgraph_get())
        rest_frame_count, held_frame_count, speed_mm = 0, 0, 0.0
        while held_frame_count < self._settings.settle_frames and rest_frame_count < MIN_REST_FRAMES:
            scene.frame_set(frame + held_frame_count)
            current_positions = self.target.positions(bpy.context.evaluated_depsgraph_get())
            offsets = current_positions - previous_positions
            speed_mm = float(np.sqrt(np.einsum("vc,vc->v", offsets, offsets).max())) * mm_per_unit
            previous_positions, held_frame_count = current_positions, held_frame_count + 1
            rest_frame_count = rest_frame_count + 1 if speed_mm <= self._settings.rest_threshold_mm else 0
        self.seconds_per_pose = time.perf_counter() - start_time
        self.is_at_rest = rest_frame_count >= MIN_REST_FRAMES
        duration = f"{held_frame_count} frames, {self.seconds_per_pose:.1f} s"
        text = f"not at rest after {duration}: {speed_mm:.2g} mm per frame"
        self.rest_description = duration if self.is_at_rest else text

    def show_frames(self, player: ClipPlayer, clip: Clip, frame_indices: Container[int]) -> Iterator[int]:
        """Show frames of a clip in their order, one for each iteration, and yield their indices in the clip.

        A simulation visits all frames up to the last of `frame_indices`.
        """
        indices = [index for index in range(len(clip.frames)) if index in frame_indices]
        with self._started_simulations(player, clip) if self.depends_on_history and indices else nullcontext():
            for index in range(indices[-1] + 1) if self.depends_on_history and indices else indices:
                player.show(clip, clip.frames[index])
                if index in frame_indices:
                    yield index

    @contextmanager
    def _started_simulations(self, player: ClipPlayer, clip: Clip) -> Iterator[None]:
        """Play simulations up to the frame before a clip."""
        pre_roll, first_frame = self._settings.pre_roll, clip.frames[0] - self._settings.pre_roll
        with temporary_frame_range(self.target, first_frame, clip.frames[-1]) if pre_roll else nullcontext():
            if pre_roll:
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
                            if channel.name == "rotation_quaternion":
                                # q and -q are the same rotation; take the nearer one. Blender normalizes quaternions.
                                end = np.where((start * end).sum(axis=1, keepdims=True) < 0, -end, end)
                            values = start + np.float32(fraction) * (end - start)
                            write(armature_object.pose.bones, channel, values)
                        armature_object.update_tag(refresh={"DATA"})
                    bpy.context.scene.frame_set(frame)
            else:
                self.target.restart_simulations()
                for frame in range(self.target.first_frame, clip.frames[0]):
                    player.show(clip, frame)
            yield


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
        settings: settings of the target.
        clips: the clips whose frames are evaluated.
        random_pose_count: number of random poses.
        controls: the controls of the recording or the model.

    Raises:
        RigError: as `find_target` and `check_clips`, or the target cannot be set to these poses.
    """
    if not settings.name:
        if settings.pre_roll or settings.settle_frames:
            raise RigError("A pre-roll and settling need a target; name one, or leave both out.")
        return DIRECT_POSE_SETTER
    target = find_target(scene_rig, settings.name, controls)
    if random_pose_count and target.follows == FRAMES:
        raise RigError(
            f"The target '{target.name}' follows frames ({target.caches[0].description}), so it cannot show random "
            "poses; record 0 random poses, and the action that it was made with."
        )
    if random_pose_count and target.follows == SIMULATION and not settings.settle_frames:
        raise RigError(
            f"The target '{target.name}' is a simulation ({target.simulations[0].description}): what it shows in a "
            "random pose depends on the pose before; let it settle, or record 0 of them, and actions."
        )
    if settings.settle_frames and (target.follows != SIMULATION or any(not c.is_simulation for c in target.caches)):
        ranged = [cache.description for cache in target.caches if not cache.is_simulation]
        reason = f"{ranged[0]} has a fixed range of frames" if ranged else "it follows the pose at once"
        raise RigError(f"The target '{target.name}' cannot settle: {reason}; leave settling out.")
    if settings.settle_frames and clips:
        raise RigError(
            f"Settled poses are random ones, and '{clips[0].name}' is to be recorded too, frame by frame; leave it "
            "out, or make a recording of each."
        )
    check_clips(target, clips, settings.pre_roll)
    return PoseSetter(target, settings)


@contextmanager
def temporary_rig_state(
    scene_rig: SceneRig, rig: Rig, channels: tuple[Channel, ...] = (), clips: tuple[Clip, ...] = ()
) -> Iterator[ClipPlayer]:
    """Set a rig to the rest pose, without animation; restore modifiers, pose, controls, animation and frame afterwards.

    In the block, time is not stretched, so frames of the scene are frames of the clips.

    Args:
        channels: the channels of the random poses that will be set.
        clips: the clips that the yielded player will show.

    Yields:
        The player of the clips.
    """
    names = control_names(rig, channels)
    with ExitStack() as stack:
        player = stack.enter_context(clip_player([(scene_rig, names)], clips))
        stack.enter_context(hidden_comparison_objects())
        for mesh_object in scene_rig.mesh_objects:
            stack.enter_context(downstream_disabled(mesh_object))
        stack.enter_context(unstretched_time())
        stack.enter_context(temporary_controls(scene_rig, names))
        yield player


def control_names(rig: Rig, channels: tuple[Channel, ...]) -> list[str]:
    """Return the names of the controls of a rig, and of further controls that random poses set."""
    sampled_controls = [channel.name for channel in channels if channel.kind == CONTROL]
    return list(dict.fromkeys([*(control.name for control in rig.controls), *sampled_controls]))
