# SPDX-License-Identifier: GPL-3.0-or-later
"""Times frames of a rig, of linear skinning and of a model.

The variants are measured alternately, so that other work on the machine slows all of them and their ratios stay right.
"""

import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import RigError
from ..core.progress import Job, Progress
from ..poses.sampling import model_channels
from ..rig.modifier_stack import check_evaluable, deforming_modifiers
from ..runtime import model_files, playback
from ..runtime.binding import model_disabled, temporary_binding, temporary_mode
from ..runtime.opened_model import open_model
from ..scene.scene_rig import SceneRig, armature_modifier, check_full_rig
from ..scene.temporary_state import deformation_disabled, temporary_attributes
from .animation import temporary_animation
from .frame_times import FrameTimes, compare_times

ROUNDS, MAX_ROUNDS = 5, 15
"""Smallest and largest number of rounds. Each round measures all variants, one after the other."""
MAX_RATIO_SPREAD = 0.1
"""Spread of the ratio of two times (`ratio_spread`) at which no further round is measured."""
WARM_UP_FRAMES = 3
"""Number of frames before each measurement that are not timed."""


@dataclass(frozen=True)
class Benchmark:
    """Times of `scene.frame_set`, including everything that it evaluates, in milliseconds.

    Attributes:
        vertices: number of vertices of the mesh.
        frames: number of timed frames of each variant.
        rig: times with all modifiers of the rig.
        linear: times with the Armature modifier alone; empty for a mesh without one.
        fdda: times with the model.
        floor: times as for `fdda`, without running the model.
        inference: times of one run of the model for one pose, outside of Blender's evaluation.
        constant_bytes: size of the constants of the model's graph, which each frame reads; 0 if unknown.
        ratios: ratio of the median times of rig and model in each round.
    """

    vertices: int
    frames: int
    rig: list[float]
    linear: list[float]
    fdda: list[float]
    floor: list[float]
    inference: list[float]
    constant_bytes: int
    ratios: list[float]

    def frame_times(self, model: str) -> FrameTimes:
        """Return the median times.

        Args:
            model: path of the model, as its binding stores it.
        """
        return FrameTimes(
            **{"linear": 0.0}
            | {variant: float(np.median(times)) for variant, times in self._times_by_variant().items()},
            constant_bytes=self.constant_bytes,
            model=model,
            ratio_low=self.ratio_range[0],
            ratio_high=self.ratio_range[1],
        )

    @property
    def ratio(self) -> float:
        """Return how many times faster a frame is with the model than with the rig."""
        return float(np.median(self.rig) / np.median(self.fdda))

    @property
    def ratio_range(self) -> tuple[float, float]:
        """Return the smallest and the largest ratio of a round."""
        return min(self.ratios), max(self.ratios)

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
                variant: {"median": _round(np.median(times)), "p90": _round(np.percentile(times, 90))}
                for variant, times in self._times_by_variant().items()
            },
            "ratio": _round(self.ratio),
            "is_faster": self.ratio > 1,
            "constant_bytes": self.constant_bytes,
        }

    def _times_by_variant(self) -> dict[str, list[float]]:
        variants = ("rig", "linear", "fdda", "floor", "inference")
        return {variant: times for variant in variants if (times := getattr(self, variant))}

    def table(self) -> str:
        """Format the times as a table, followed by a sentence that compares rig and model."""
        labels = {
            "rig": "rig",
            "linear": "Armature modifier alone",
            "fdda": "FDDA",
            "floor": "FDDA without running the model",
            "inference": "the model alone, one pose",
        }
        lines = [f"{f'{self.vertices} vertices, ms per frame':<33}{'median':>10}{'p90':>10}"]
        for variant, times in self._times_by_variant().items():
            lines.append(f"  {labels[variant]:<31}{np.median(times):>10.3f}{np.percentile(times, 90):>10.3f}")
        if self.constant_bytes:
            lines.append(f"  {'model data read per frame, MB':<31}{self.constant_bytes / 1e6:>10.2f}")
        lines.append(f"  {compare_times(*map(float, map(np.median, (self.rig, self.fdda))), self.ratio_range)}")
        return "\n".join(lines)


def _round(value: float) -> float:
    return round(float(value), 4)


def benchmark(scene_rig: SceneRig, model: Path | None, frames: int) -> Job[Benchmark]:
    """Time a rig and a model while the generator is iterated.

    It plays the action of the armature, or random poses if there is none, and restores the scene afterwards.

    Args:
        model: path of the model; None for the bound model.
        frames: number of frames to time for each variant.

    Raises:
        RigError: as `check_full_rig`, or the rig cannot be evaluated.
        ModelError: the model cannot be read, or was trained for another rig.
    """
    check_full_rig(scene_rig.mesh_object)
    check_evaluable(scene_rig)
    mesh_object = scene_rig.mesh_object
    opened_model = open_model(scene_rig, model or model_files.network_of(mesh_object))
    channels = model_channels(scene_rig, opened_model.rig, opened_model.network.info)
    binding = temporary_binding(scene_rig, model) if model else model_disabled(mesh_object)
    with temporary_animation(scene_rig, channels) as animation_frames, binding:
        show_variant = {
            "rig": model_disabled,
            "linear": skinning_only,
            "fdda": partial(temporary_mode, mode="FDDA"),
            "floor": _playback_without_model_runs,
        }
        if armature_modifier(mesh_object) is None:
            del show_variant["linear"]
        times: dict[str, list[float]] = {variant: [] for variant in show_variant}
        frames_per_round = max(1, -(-frames // ROUNDS))
        ratios: list[float] = []
        while len(ratios) < ROUNDS or (len(ratios) < MAX_ROUNDS and ratio_spread(ratios) > MAX_RATIO_SPREAD):
            medians: dict[str, float] = {}
            round_count = max(ROUNDS, len(ratios) + 1)
            for number, (variant, show) in enumerate(show_variant.items(), 1):
                with show(mesh_object):
                    round_times = time_frames(animation_frames, len(ratios) * frames_per_round, frames_per_round)
                times[variant] += round_times
                medians[variant] = float(np.median(round_times))
                done = len(ratios) * len(show_variant) + number
                yield Progress("benchmark", done, round_count * len(show_variant))
            ratios.append(medians["rig"] / medians["fdda"])
        network = model_files.network_of(mesh_object)
        pose_matrices = network.info.rest_matrices[None]
        controls = np.zeros((1, len(network.info.controls)), np.float32)
        calls = [lambda: network.positions(pose_matrices, controls)] * (frames + WARM_UP_FRAMES)
        inference = time_calls(calls)[WARM_UP_FRAMES:]
    return Benchmark(
        len(mesh_object.data.vertices),
        frames_per_round * len(ratios),
        **{"linear": [], **times},
        inference=inference,
        constant_bytes=network.info.constant_bytes,
        ratios=ratios,
    )


def ratio_spread(ratios: list[float]) -> float:
    """Return the distance of the quartiles of measured ratios, relative to their median."""
    low, middle, high = np.percentile(ratios, (25, 50, 75))
    return float((high - low) / middle)


def time_frames(animation_frames: range, first_index: int, count: int) -> list[float]:
    """Time frames of an animation after some warm-up frames.

    Args:
        first_index: index of the first timed frame in the animation. After its end the animation starts again.
        count: number of frames to time.

    Returns:
        Milliseconds of each timed frame.
    """
    scene = bpy.context.scene

    def make_call(index: int) -> Callable[[], None]:
        return lambda: scene.frame_set(animation_frames[index % len(animation_frames)])

    calls = [make_call(first_index + offset) for offset in range(-WARM_UP_FRAMES, count)]
    return time_calls(calls)[WARM_UP_FRAMES:]


def time_calls(calls: list[Callable[[], object]]) -> list[float]:
    """Time each call, in milliseconds."""
    times = []
    for call in calls:
        start = time.perf_counter()
        call()
        times.append((time.perf_counter() - start) * 1000)
    return times


@contextmanager
def skinning_only(mesh_object: bpy.types.Object) -> Iterator[None]:
    """Show Blender's own linear skinning in the block: the Armature modifier alone, with the first shape key pinned."""
    skin_modifier = armature_modifier(mesh_object)
    if skin_modifier is None:
        raise RigError(f"'{mesh_object.name}' has no Armature modifier: there is no linear skinning to time.")
    with model_disabled(mesh_object):
        other_modifiers = [modifier for modifier in deforming_modifiers(mesh_object) if modifier != skin_modifier]
        linear = temporary_attributes(skin_modifier, use_deform_preserve_volume=False)
        with deformation_disabled(mesh_object, other_modifiers), linear:
            yield


@contextmanager
def _playback_without_model_runs(mesh_object: bpy.types.Object) -> Iterator[None]:
    """Play the bound model in the block without running it."""
    with temporary_mode(mesh_object, "FDDA"):
        bpy.context.view_layer.update()
        with playback.without_model_runs():
            yield
