# SPDX-License-Identifier: GPL-3.0-or-later
"""The last measured frame times of each mesh object, for the sidebar."""

from dataclasses import dataclass

import bpy

from . import measurements

MIN_WORTHWHILE_RATIO = 1.5
"""Smallest ratio of the frame times of rig and model at which a model is worth it."""

VERB = "measure_model"
"""The verb that measures frame times (`measurements`)."""


@dataclass(frozen=True)
class FrameTimes:
    """Median times of a frame in milliseconds, as in `Benchmark`.

    Attributes:
        rig: time with all modifiers of the rig.
        linear: time with the Armature modifier alone; 0 for a mesh without one.
        fdda: time with the model.
        floor: time as for `fdda`, without running the model.
        inference: time of one run of the model for one pose, outside of Blender's evaluation.
        constant_bytes: size of the constants of the model's graph, which each frame reads; 0 if unknown.
        model: path of the model, as its binding stores it.
        ratio_low, ratio_high: smallest and largest ratio of the times of rig and model in a round of measurements.
    """

    rig: float
    linear: float
    fdda: float
    floor: float
    inference: float
    constant_bytes: int
    model: str
    ratio_low: float = 0.0
    ratio_high: float = 0.0

    @property
    def is_worthwhile(self) -> bool:
        """Return whether the model is clearly faster than the rig."""
        return self.rig >= MIN_WORTHWHILE_RATIO * self.fdda

    @property
    def sentence(self) -> str:
        """Return a sentence that compares rig and model."""
        return compare_times(self.rig, self.fdda, (self.ratio_low, self.ratio_high))


def compare_times(rig_ms: float, fdda_ms: float, ratio_range: tuple[float, float] = (0.0, 0.0)) -> str:
    """Return a sentence that compares rig and model.

    Args:
        rig_ms, fdda_ms: milliseconds per frame.
        ratio_range: smallest and largest measured ratio of both; zeros for one measurement.
    """
    ratio, (low, high) = rig_ms / fdda_ms, ratio_range
    spread = f" ({low:.1f} to {high:.1f} in repeated measurements)" if f"{low:.1f}" != f"{high:.1f}" else ""
    if ratio >= MIN_WORTHWHILE_RATIO:
        return f"{ratio:.1f}x faster than the rig{spread}."
    if ratio > 1:
        return f"Little difference: {ratio:.1f}x faster than the rig{spread}."
    return f"Not worth it here: this rig is faster than the model{spread}."


def store(mesh_object: bpy.types.Object, times: FrameTimes) -> None:
    """Store the frame times of an object with its bound model."""
    measurements.store(VERB, mesh_object, times)


def get(mesh_object: bpy.types.Object) -> FrameTimes | None:
    """Return the frame times of an object with its bound model; None if they were not measured."""
    times = measurements.last(VERB, mesh_object)
    return times if times and times.model == mesh_object.fdda.model else None


def remove(mesh_object: bpy.types.Object) -> None:
    """Remove the frame times of an object, because its model has changed."""
    measurements.remove(VERB, mesh_object)
