# SPDX-License-Identifier: GPL-3.0-or-later
"""Times the evaluation of scenes and the drawing of windows."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.progress import Job, Progress
from ..scene.temporary_state import temporary_attributes

WARM_UP_FRAMES = 2
"""Number of frames before each measurement that are not timed."""
ARMATURE_SCENE_NAME = "FDDA Profile"
"""Name of the temporary scene with one armature object."""


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
    def of(rounds: list[float]) -> "Duration":
        """Return the duration for the times of several rounds, ms."""
        first_quartile, median, third_quartile = np.percentile(rounds, (25, 50, 75))
        return Duration(max(float(median), 0.0), float(third_quartile - first_quartile) / 2)

    @property
    def is_clear(self) -> bool:
        """Whether the median is larger than the spread; otherwise it is noise."""
        return self.median > self.spread

    def to_json(self) -> dict:
        return {"median": round(self.median, 4), "spread": round(self.spread, 4)}

    def __str__(self) -> str:
        return f"{self.median:.2f} ± {self.spread:.2f}"


def scene_times(scene: bpy.types.Scene, animation_frames: range, first_index: int, count: int) -> float:
    """Return the time of the evaluation of a scene's frame, ms: the lower quartile over the timed frames.

    Other work on the machine only adds time, so the lower quartile depends less on it than the median.

    Args:
        scene: the scene; it need not be shown.
        animation_frames: frames of the animation; after its end the animation starts again.
        first_index: index of the first timed frame in the animation.
        count: number of frames to time.
    """
    times = []
    for offset in range(-WARM_UP_FRAMES, count):
        frame = animation_frames[(first_index + offset) % len(animation_frames)]
        start = time.perf_counter()
        scene.frame_set(frame)
        if offset >= 0:
            times.append((time.perf_counter() - start) * 1000)
    return float(np.percentile(times, 25))


@contextmanager
def temporary_armature_scene(armature_object: bpy.types.Object) -> Iterator[bpy.types.Scene]:
    """Create a scene with an armature object alone, and what its bones depend on; remove it afterwards."""
    scene = bpy.data.scenes.new(ARMATURE_SCENE_NAME)
    try:
        scene.collection.objects.link(armature_object)
        with temporary_attributes(armature_object, hide_viewport=False):
            yield scene
    finally:
        bpy.data.scenes.remove(scene)


def time_redraws(frames: range, rounds: int, frames_per_round: int) -> Job[list[float]]:
    """Time the drawing of the active window after each frame, which includes sending changed meshes to the GPU.

    Returns:
        Median of each round, ms; empty without a window.
    """
    medians: list[float] = []
    window = None if bpy.app.background else bpy.context.window_manager.windows[0]
    for round_index in range(rounds if window else 0):
        times = []
        with bpy.context.temp_override(window=window):
            for offset in range(-WARM_UP_FRAMES, frames_per_round):
                bpy.context.scene.frame_set(frames[(round_index * frames_per_round + offset) % len(frames)])
                start = time.perf_counter()
                bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
                if offset >= 0:
                    times.append((time.perf_counter() - start) * 1000)
        medians.append(float(np.median(times)))
        yield Progress("drawing", round_index + 1, rounds)
    return medians
