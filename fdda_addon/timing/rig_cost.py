# SPDX-License-Identifier: GPL-3.0-or-later
"""What a frame of a rig costs, and whether a model would cost less. Measured before there is a model."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..core.progress import Progress
from ..rig.modifier_stack import check_evaluable
from ..runtime.binding import model_disabled
from ..scene.scene_rig import SceneRig
from .benchmark import playing, skinning_only, time_frames

ROUNDS = 4
FRAMES_EACH = 5

PLAYBACK_MS = ((1_476, 0.50), (9_960, 0.51), (50_618, 0.73))
"""By vertex count: what a frame with a model costs beyond the Armature modifier alone, ms; from docs/benchmarks.md."""
MIN_CLEAR_SPEEDUP = 1.3
"""Below this an estimate is too close to call."""


@dataclass(frozen=True)
class RigCost:
    """Milliseconds of a frame, medians.

    Attributes:
        vertices: of the mesh.
        rig: with all modifiers of the rig.
        linear: with its Armature modifier alone.
    """

    vertices: int
    rig: float
    linear: float

    @property
    def model(self) -> float:
        """Estimate of a frame with a model, ms."""
        return self.linear + estimated_playback(self.vertices)

    @property
    def sentence(self) -> str:
        """Whether a model would pay."""
        gain = self.rig / self.model
        if gain >= MIN_CLEAR_SPEEDUP:
            return f"Worth it: about {gain:.1f}x faster."
        if gain >= 1 / MIN_CLEAR_SPEEDUP:
            return "Little difference: a model takes about as long as this rig."
        return "Not worth it here: this rig is faster than a model."


def estimated_playback(vertices: int) -> float:
    """What the playback of a model costs a frame, ms: between the meshes that were measured, in proportion beyond."""
    counts, times = np.array(PLAYBACK_MS).T
    if vertices <= counts[-1]:
        return float(np.interp(vertices, counts, times))
    slope = (times[-1] - times[-2]) / (counts[-1] - counts[-2])
    return float(times[-1] + slope * (vertices - counts[-1]))


def measure(scene_rig: SceneRig) -> Iterator[Progress | RigCost]:
    """Time a rig and its Armature modifier alone, in turn; a generator that does the work while it is iterated.

    The armature's action is played, or random poses where it has none. The scene is as before afterwards.

    Yields:
        Progress, and as the last thing the RigCost.

    Raises:
        RigError: the rig cannot be evaluated.
    """
    mesh_object = scene_rig.mesh_object
    with model_disabled(mesh_object):
        check_evaluable(scene_rig)
        times: dict[str, list[float]] = {"rig": [], "linear": []}
        with playing(scene_rig) as frames:
            for number in range(ROUNDS):
                times["rig"] += time_frames(frames, number * FRAMES_EACH, FRAMES_EACH)
                yield Progress("frames", 2 * number + 1, 2 * ROUNDS)
                with skinning_only(mesh_object):
                    times["linear"] += time_frames(frames, number * FRAMES_EACH, FRAMES_EACH)
                yield Progress("frames", 2 * number + 2, 2 * ROUNDS)
    yield RigCost(len(mesh_object.data.vertices), *(float(np.median(times[way])) for way in ("rig", "linear")))
