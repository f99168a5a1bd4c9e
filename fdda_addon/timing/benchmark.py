# SPDX-License-Identifier: GPL-3.0-or-later
"""Times frames of a rig, of linear skinning and of a model in turn, so that the ratios hold on a noisy machine."""

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
"""Number of times that each setup is measured, in turn."""
WARM_UP_FRAMES = 3
RANDOM_POSES, KEY_STEP = 20, 5
"""Number of random poses that animate a rig without an action, and the frames between them."""


@dataclass(frozen=True)
class Benchmark:
    """Times of `scene.frame_set`, with everything that it evaluates, in milliseconds.

    Attributes:
        vertices: number of vertices of the mesh.
        frames: number of frames for each setup.
        rig: times with all modifiers of the rig.
        linear: times with the Armature modifier alone.
        fdda: times with the model.
        floor: times as for `fdda`, without running the model.
        inference: times of the model alone, for one pose.
        constant_bytes: size of the constants of the model's graph, which each frame reads; 0 if unknown.
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
        """Return the medians.

        Args:
            model: path of the model, as its binding stores it.
        """
        return FrameTimes(
            **{setup: float(np.median(times)) for setup, times in self._times()},
            constant_bytes=self.constant_bytes,
            model=model,
        )

    @property
    def ratio(self) -> float:
        """Return how many times faster a frame is with the model than with the rig."""
        return float(np.median(self.rig) / np.median(self.fdda))

    def to_json(self) -> dict:
        """Return the times as JSON, described in docs/formats.md."""
        return {
            "unit": "ms",
            "vertices": self.vertices,
            "frames": self.frames,
            "blender": bpy.app.version_string,
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            **{
                name: {"median": _round(np.median(t)), "p90": _round(np.percentile(t, 90))} for name, t in self._times()
            },
            "ratio": _round(self.ratio),
            "is_faster": self.ratio > 1,
            "constant_bytes": self.constant_bytes,
        }

    def _times(self) -> list[tuple[str, list[float]]]:
        return [(setup, getattr(self, setup)) for setup in ("rig", "linear", "fdda", "floor", "inference")]

    def table(self) -> str:
        """Format the times as text, with a verdict."""
        labels = {
            "rig": "rig",
            "linear": "Armature modifier alone",
            "fdda": "FDDA",
            "floor": "FDDA without running the model",
            "inference": "the model alone, one pose",
        }
        lines = [f"{f'{self.vertices} vertices, ms per frame':<33}{'median':>10}{'p90':>10}"]
        for setup, times in self._times():
            lines.append(f"  {labels[setup]:<31}{np.median(times):>10.3f}{np.percentile(times, 90):>10.3f}")
        if self.constant_bytes:
            lines.append(f"  {'model data read per frame, MB':<31}{self.constant_bytes / 1e6:>10.2f}")
        lines.append(f"  {verdict(float(np.median(self.rig)), float(np.median(self.fdda)))}")
        return "\n".join(lines)


def _round(value: float) -> float:
    return round(float(value), 4)


def benchmark(scene_rig: SceneRig, model: Path | None, frames: int) -> Iterator[Progress | Benchmark]:
    """Time a rig and a model, as a generator that works while it is iterated.

    It plays the action of the armature, or random poses if there is none, and restores the scene afterwards.

    Args:
        scene_rig: the rig.
        model: path of the model; None for the bound model.
        frames: number of frames to time for each setup.

    Yields:
        Progress, and the Benchmark at the end.

    Raises:
        RigError: the rig cannot be evaluated.
        ModelError: the model cannot be read, or was trained for another rig.
    """
    check_evaluable(scene_rig)
    mesh_object = scene_rig.mesh_object
    opened = open_model(scene_rig, model or model_files.network_of(mesh_object))
    channels = model_channels(scene_rig, opened.rig, opened.network.info)
    with temporary_animation(scene_rig, channels) as played, temporary_binding(scene_rig, model):
        setups = {
            "rig": model_disabled,
            "linear": skinning_only,
            "fdda": partial(temporary_mode, mode="FDDA"),
            "floor": _floor,
        }
        times: dict[str, list[float]] = {setup: [] for setup in setups}
        frames_per_round = max(1, -(-frames // ROUNDS))
        for round_index in range(ROUNDS):
            for setup_number, (setup, prepare) in enumerate(setups.items(), 1):
                with prepare(mesh_object):
                    times[setup] += time_frames(played, round_index * frames_per_round, frames_per_round)
                yield Progress("benchmark", round_index * len(setups) + setup_number, ROUNDS * len(setups))
        network = model_files.network_of(mesh_object)
        pose_matrices = network.info.rest_matrices[None]
        controls = np.zeros((1, len(network.info.controls)), np.float32)
        calls = [lambda: network.positions(pose_matrices, controls)] * (frames + WARM_UP_FRAMES)
        inference = _time_calls(calls)[WARM_UP_FRAMES:]
    yield Benchmark(
        len(mesh_object.data.vertices),
        frames_per_round * ROUNDS,
        **times,
        inference=inference,
        constant_bytes=network.info.constant_bytes,
    )


@contextmanager
def temporary_animation(scene_rig: SceneRig, channels: tuple[Channel, ...] = ()) -> Iterator[range]:
    """Play the action of an armature, or `random_action` if it has none; restore pose and animation afterwards.

    Yields:
        The frames of the action.
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
    """Key random poses on the armature, `KEY_STEP` frames apart, and return its action.

    Args:
        scene_rig: the rig.
        channels: the channels of the poses, except controls; empty for those of the rig.
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
    """Time frames of an animation after some warm-up frames.

    Args:
        played: frames of the animation.
        first: index of the first frame; indices wrap around.
        count: number of frames.

    Returns:
        Milliseconds of each frame.
    """
    scene = bpy.context.scene

    def frame_call(index: int) -> Callable[[], None]:
        return lambda: scene.frame_set(played[index % len(played)])

    return _time_calls([frame_call(first + offset) for offset in range(-WARM_UP_FRAMES, count)])[WARM_UP_FRAMES:]


def _time_calls(calls: list[Callable[[], object]]) -> list[float]:
    """Time each call, in milliseconds."""
    times = []
    for call in calls:
        start = time.perf_counter()
        call()
        times.append((time.perf_counter() - start) * 1000)
    return times


@contextmanager
def skinning_only(mesh_object: bpy.types.Object) -> Iterator[None]:
    """Show Blender's own linear skinning: the Armature modifier alone, with pinned shape keys."""
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
    """Play without running the model."""
    with temporary_mode(mesh_object, "FDDA"):
        bpy.context.view_layer.update()
        with playback.without_model_runs():
            yield
