# SPDX-License-Identifier: GPL-3.0-or-later
"""Times the evaluation of scenes and the drawing of windows."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import bpy
import numpy as np

from ..core.progress import Job, Progress
from ..scene.temporary_state import temporary_attributes

WARM_UP_FRAMES = 3
"""Number of frames before each measurement that are not timed."""
TEMPORARY_SCENE_NAME = "FDDA Profile"
"""Name of temporary scenes."""


@dataclass(frozen=True)
class Duration:
    """A time in milliseconds, from several rounds.

    Attributes:
        median: median over the rounds; at least 0, because differences of noisy times may be negative.
        spread: half the distance between the quartiles of the rounds.
    """

    median: float
    spread: float

    @staticmethod
    def of(rounds: Sequence[float]) -> "Duration":
        """Return the duration for the times of several rounds, ms."""
        first_quartile, median, third_quartile = np.percentile(rounds, (25, 50, 75))
        return Duration(max(float(median), 0.0), float(third_quartile - first_quartile) / 2)

    def to_json(self) -> dict:
        return {"median": round(self.median, 4), "spread": round(self.spread, 4)}

    def __str__(self) -> str:
        return f"{self.median:.2f} ± {self.spread:.2f}"


def time_frames(scene: bpy.types.Scene, animation_frames: range, first_index: int, count: int) -> list[float]:
    """Time the evaluation of frames of a scene (`scene.frame_set`), after frames that warm up, in milliseconds.

    Args:
        scene: the scene; it need not be shown.
        animation_frames: frames of the animation; after its end the animation starts again.
        first_index: index of the first timed frame in the animation.
        count: number of frames to time.
    """
    indices = range(first_index - WARM_UP_FRAMES, first_index + count)
    return time_calls(partial(scene.frame_set, animation_frames[i % len(animation_frames)]) for i in indices)


def time_calls(calls: Iterable[Callable[[], object]]) -> list[float]:
    """Time each call, but for those that warm up, in milliseconds. Work between the calls is not timed."""
    times = []
    for call in calls:
        start = time.perf_counter()
        call()
        times.append((time.perf_counter() - start) * 1000)
    return times[WARM_UP_FRAMES:]


def frame_ms(scene: bpy.types.Scene, animation_frames: range, first_index: int, count: int) -> float:
    """Return the lower quartile of `time_frames`: other work on the machine only adds time."""
    return float(np.percentile(time_frames(scene, animation_frames, first_index, count), 25))


@contextmanager
def temporary_scene(objects: Iterable[bpy.types.Object]) -> Iterator[bpy.types.Scene]:
    """Create a scene with objects, and what they depend on; remove it afterwards."""
    scene = bpy.data.scenes.new(TEMPORARY_SCENE_NAME)
    try:
        for scene_object in objects:
            scene.collection.objects.link(scene_object)
        yield scene
    finally:
        bpy.data.scenes.remove(scene)


@contextmanager
def temporary_armature_scene(armature_object: bpy.types.Object) -> Iterator[bpy.types.Scene]:
    """Create a scene with an armature object alone, and what its bones depend on; remove it afterwards."""
    with temporary_scene([armature_object]) as scene, temporary_attributes(armature_object, hide_viewport=False):
        yield scene


def time_redraws(frames: range, rounds: int, frames_per_round: int) -> Job[list[float]]:
    """Time the drawing of the active window after each frame, which includes sending changed meshes to the GPU.

    Returns:
        Median of each round, ms; empty without a window.
    """
    medians: list[float] = []
    window = None if bpy.app.background else bpy.context.window_manager.windows[0]

    def redraws(first_index: int) -> Iterator[Callable[[], object]]:
        for index in range(first_index - WARM_UP_FRAMES, first_index + frames_per_round):
            bpy.context.scene.frame_set(frames[index % len(frames)])
            yield partial(bpy.ops.wm.redraw_timer, type="DRAW_WIN_SWAP", iterations=1)

    for round_index in range(rounds if window else 0):
        with bpy.context.temp_override(window=window):
            times = time_calls(redraws(round_index * frames_per_round))
        medians.append(float(np.median(times)))
        yield Progress("drawing", round_index + 1, rounds)
    return medians
