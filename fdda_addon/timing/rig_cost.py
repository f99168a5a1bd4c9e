# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures the time of a frame with a rig, and estimates the time with a model before a model is trained."""

from dataclasses import dataclass

import numpy as np

from ..core.progress import Job, Progress
from ..rig.modifier_stack import check_evaluable
from ..runtime.binding import model_disabled
from ..scene.scene_rig import SceneRig, check_full_rig
from .animation import temporary_animation
from .benchmark import MAX_RATIO_SPREAD, ratio_spread, skinning_only, time_frames
from .frame_times import MIN_WORTHWHILE_RATIO

ROUNDS, MAX_ROUNDS = 4, 12
"""Smallest and largest number of rounds. Each measures the rig and its Armature modifier alone, one after the other."""
FRAMES_PER_ROUND = 5

PLAYBACK_MS, PLAYBACK_MS_PER_VERTEX = 0.26, 4.7e-6
"""Coefficients of the line that fits the time of a frame with a model beyond that of the Armature modifier alone, ms.
They are fitted to "Frame times" in docs/benchmarks.md (`make bench`)."""
ESTIMATE_ERROR_MS = 0.2
"""Largest difference between the line and the measured times."""


@dataclass(frozen=True)
class RigCost:
    """Median times of a frame in milliseconds.

    Attributes:
        vertices: number of vertices of the mesh.
        rig: time with all modifiers of the rig.
        linear: time with the Armature modifier alone.
    """

    vertices: int
    rig: float
    linear: float

    @property
    def model(self) -> float:
        """Return the estimated time of a frame with a model, ms."""
        return self.linear + estimate_playback_ms(self.vertices)

    @property
    def sentence(self) -> str:
        """Return a sentence that says whether a model would be faster than the rig."""
        speedup = self.rig / self.model
        if speedup >= MIN_WORTHWHILE_RATIO:
            slow, fast = self.model + ESTIMATE_ERROR_MS, max(self.linear, self.model - ESTIMATE_ERROR_MS)
            return f"Worth it: {self.rig / slow:.1f} to {self.rig / fast:.1f}x faster (estimate)."
        if speedup >= 1 / MIN_WORTHWHILE_RATIO:
            return "Little difference: a model takes about as long as this rig (estimate)."
        return "Not worth it here: this rig is faster than a model (estimate)."


def estimate_playback_ms(vertex_count: int) -> float:
    """Estimate how much longer a frame takes with a model than with the Armature modifier alone, ms."""
    return PLAYBACK_MS + PLAYBACK_MS_PER_VERTEX * vertex_count


def measure(scene_rig: SceneRig) -> Job[RigCost]:
    """Time a rig and its Armature modifier alone, alternately, while the generator is iterated.

    It plays the action of the armature, or random poses if there is none, and restores the scene afterwards.

    Raises:
        RigError: as `check_full_rig`, or the rig cannot be evaluated.
    """
    mesh_object = scene_rig.mesh_object
    check_full_rig(mesh_object)
    with model_disabled(mesh_object):
        check_evaluable(scene_rig)
        times: dict[str, list[float]] = {"rig": [], "linear": []}
        with temporary_animation(scene_rig) as frames:
            ratios: list[float] = []
            while len(ratios) < ROUNDS or (len(ratios) < MAX_ROUNDS and ratio_spread(ratios) > MAX_RATIO_SPREAD):
                first_index, done = len(ratios) * FRAMES_PER_ROUND, 2 * len(ratios)
                total = 2 * max(ROUNDS, len(ratios) + 1)
                rig_times = time_frames(frames, first_index, FRAMES_PER_ROUND)
                yield Progress("frames", done + 1, total)
                with skinning_only(mesh_object):
                    linear_times = time_frames(frames, first_index, FRAMES_PER_ROUND)
                yield Progress("frames", done + 2, total)
                ratios.append(float(np.median(rig_times) / np.median(linear_times)))
                times["rig"] += rig_times
                times["linear"] += linear_times
    return RigCost(len(mesh_object.data.vertices), *(float(np.median(times[variant])) for variant in ("rig", "linear")))
