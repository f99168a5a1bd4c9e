# SPDX-License-Identifier: GPL-3.0-or-later
"""Times a whole frame of a rig three ways in one process, in turn, so that the ratios hold on a noisy machine."""

import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import RigError
from ..core.poses import CONTROL, ROTATION, ROTATION_VECTOR, Channel, sample_pose
from ..core.progress import Progress
from ..poses.action_range import action_frames
from ..poses.sampling import model_channels, sampled_channels
from ..rig.modifier_stack import check_evaluable, deforming_modifiers
from ..rig.reading import read_rig
from ..runtime import model_files, playback
from ..runtime.binding import model_disabled, temporary_binding, temporary_mode
from ..runtime.opened_model import open_model
from ..scene.armature import Poser, clear_pose
from ..scene.comparison import hidden_comparisons
from ..scene.scene_rig import SceneRig, armature_modifier
from ..scene.temporary_state import assign_action, temporary_attributes, temporary_pose
from .frame_times import FrameTimes, verdict

ROUNDS = 5
"""How often the ways take turns."""
WARM_UP = 3
RANDOM_POSES, KEY_STEP = 20, 5
"""Poses of the animation of a rig that has none, and the frames between them."""


@dataclass(frozen=True)
class Benchmark:
    """Times of a frame, `scene.frame_set` and all that it evaluates, in milliseconds.

    Attributes:
        vertices: of the mesh. frames: that were timed, each way.
        rig: all modifiers of the rig. linear: its Armature modifier alone. fdda: the model in their place.
        floor: as fdda, with constant positions in place of the model's.
        inference: the model alone, one pose.
        constant_bytes: of the model's graph, all of which a frame reads; 0 where the model does not say.
    """

    vertices: int
    frames: int
    rig: list[float]
    linear: list[float]
    fdda: list[float]
    floor: list[float]
    inference: list[float]
    constant_bytes: int

    def frame_times(self, model: str) -> FrameTimes:
        """The medians, for a model's file."""
        return FrameTimes(
            **{way: float(np.median(times)) for way, times in self._times()},
            constant_bytes=self.constant_bytes,
            model=model,
        )

    @property
    def ratio(self) -> float:
        """How many times faster a frame is with the model than with the rig."""
        return float(np.median(self.rig) / np.median(self.fdda))

    def to_json(self) -> dict:
        """docs/formats.md describes it."""
        return {
            "unit": "ms",
            "vertices": self.vertices,
            "frames": self.frames,
            "blender": bpy.app.version_string,
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            **{way: {"median": _round(np.median(t)), "p90": _round(np.percentile(t, 90))} for way, t in self._times()},
            "ratio": _round(self.ratio),
            "pays": self.ratio > 1,
            "constant_bytes": self.constant_bytes,
        }

    def _times(self) -> list[tuple[str, list[float]]]:
        return [(way, getattr(self, way)) for way in ("rig", "linear", "fdda", "floor", "inference")]

    def table(self) -> str:
        """The times as text, and whether the model pays."""
        labels = {
            "rig": "true rig",
            "linear": "Armature modifier alone",
            "fdda": "FDDA",
            "floor": "FDDA, constant positions",
            "inference": "the model alone, one pose",
        }
        lines = [f"{self.vertices} vertices, ms a frame{'median':>12}{'p90':>10}"]
        for way, times in self._times():
            lines.append(f"  {labels[way]:<27}{np.median(times):>10.3f}{np.percentile(times, 90):>10.3f}")
        if self.constant_bytes:
            lines.append(f"  {'a frame reads of the model, MB':<31}{self.constant_bytes / 1e6:>6.2f}")
        lines.append(f"  {verdict(float(np.median(self.rig)), float(np.median(self.fdda)))}")
        return "\n".join(lines)


def _round(value: float) -> float:
    return round(float(value), 4)


def benchmark(scene_rig: SceneRig, model: Path | None, frames: int) -> Iterator[Progress | Benchmark]:
    """Time a rig and a model in its place; a generator that does the work while it is iterated.

    The armature's action is played, or random poses where it has none. The scene is as before afterwards.

    Args:
        scene_rig: the rig.
        model: the model, None for the one that is bound.
        frames: to time, each way.

    Yields:
        Progress, and as the last thing the Benchmark.

    Raises:
        RigError: the rig cannot be evaluated.
        ModelError: the model cannot be read, or is of another rig.
    """
    check_evaluable(scene_rig)
    mesh_object = scene_rig.mesh_object
    opened = open_model(scene_rig, model or model_files.network_of(mesh_object))
    channels = model_channels(scene_rig, opened.rig, opened.network.info)
    with playing(scene_rig, channels) as played, temporary_binding(scene_rig, model):
        ways = {
            "rig": model_disabled,
            "linear": skinning_only,
            "fdda": partial(temporary_mode, mode="FDDA"),
            "floor": _floor,
        }
        times: dict[str, list[float]] = {way: [] for way in ways}
        each = max(1, -(-frames // ROUNDS))
        for number in range(ROUNDS):
            for place, (way, prepare) in enumerate(ways.items(), 1):
                with prepare(mesh_object):
                    times[way] += time_frames(played, number * each, each)
                yield Progress("benchmark", number * len(ways) + place, ROUNDS * len(ways))
        network = model_files.network_of(mesh_object)
        pose = network.info.rest_matrices[None]
        controls = np.zeros((1, len(network.info.controls)), np.float32)
        inference = _time([lambda: network.positions(pose, controls)] * (frames + WARM_UP))[WARM_UP:]
    yield Benchmark(
        len(mesh_object.data.vertices),
        each * ROUNDS,
        **times,
        inference=inference,
        constant_bytes=network.info.constant_bytes,
    )


@contextmanager
def playing(scene_rig: SceneRig, channels: tuple[Channel, ...] = ()) -> Iterator[range]:
    """Let its action drive the armature, one of random poses (`random_action`) where it has none; gives the frames.

    Pose and animation are as before afterwards.
    """
    animation = scene_rig.armature_object.animation_data
    own_action = animation.action if animation else None
    with hidden_comparisons(), temporary_pose(scene_rig.armature_object, [own_action] if own_action else []):
        action = own_action or random_action(scene_rig, channels)
        assign_action(scene_rig.armature_object, action)
        try:
            yield action_frames(action)
        finally:
            scene_rig.armature_object.animation_data.action = None
            if action != own_action:
                bpy.data.actions.remove(action)


def random_action(scene_rig: SceneRig, channels: tuple[Channel, ...] = ()) -> bpy.types.Action:
    """Key random poses on the armature, a pose every few frames; its action.

    Args:
        scene_rig: the rig.
        channels: what a pose moves, those of the rig when left out; controls are left as they are.
    """
    armature_object = scene_rig.armature_object
    channels = [c for c in channels or sampled_channels(scene_rig, read_rig(scene_rig)) if c.kind != CONTROL]
    clear_pose(armature_object)
    poser = Poser(scene_rig, channels)
    paths = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}
    for index in range(RANDOM_POSES):
        poser.set(sample_pose(channels, 0, index))
        for name, kind in {(channel.name, channel.kind) for channel in channels}:
            bone = armature_object.pose.bones[name]
            path = paths.get(bone.rotation_mode, "rotation_euler") if kind in {ROTATION, ROTATION_VECTOR} else kind
            bone.keyframe_insert(path, frame=1 + index * KEY_STEP)
    return armature_object.animation_data.action


def time_frames(played: range, first: int, count: int) -> list[float]:
    """Milliseconds of `count` frames from the animation, the first few not counted."""
    scene = bpy.context.scene

    def show(number: int) -> Callable[[], None]:
        return lambda: scene.frame_set(played[number % len(played)])

    return _time([show(first + number) for number in range(-WARM_UP, count)])[WARM_UP:]


def _time(calls: list[Callable[[], object]]) -> list[float]:
    """Milliseconds of each call."""
    times = []
    for call in calls:
        start = time.perf_counter()
        call()
        times.append((time.perf_counter() - start) * 1000)
    return times


@contextmanager
def skinning_only(mesh_object: bpy.types.Object) -> Iterator[None]:
    """Blender's own linear skinning: the Armature modifier alone, shape keys pinned."""
    skinning = armature_modifier(mesh_object)
    if skinning is None:
        raise RigError(f"'{mesh_object.name}' has no Armature modifier: there is no linear skinning to time.")
    with model_disabled(mesh_object), ExitStack() as stack:
        for modifier in deforming_modifiers(mesh_object):
            if modifier != skinning:
                stack.enter_context(temporary_attributes(modifier, show_viewport=False))
        stack.enter_context(temporary_attributes(skinning, use_deform_preserve_volume=False))
        if mesh_object.data.shape_keys:
            stack.enter_context(temporary_attributes(mesh_object, show_only_shape_key=True, active_shape_key_index=0))
        yield


@contextmanager
def _floor(mesh_object: bpy.types.Object) -> Iterator[None]:
    """The playback with a model that costs nothing: it answers the same positions for every pose."""
    with temporary_mode(mesh_object, "FDDA"):
        bpy.context.view_layer.update()
        with playback.without_model_runs():
            yield
