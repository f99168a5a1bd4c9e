# SPDX-License-Identifier: GPL-3.0-or-later
"""Stores the last measured frame times of each mesh object for the session, for the sidebar."""

from dataclasses import dataclass

import bpy

_frame_times: dict[int, "FrameTimes"] = {}
"""Frame times, by the session ids of mesh objects."""


@dataclass(frozen=True)
class FrameTimes:
    """Median times of a frame in milliseconds, as in `Benchmark`.

    Attributes:
        rig: time with all modifiers of the rig.
        linear: time with the Armature modifier alone.
        fdda: time with the model.
        floor: time as for `fdda`, without running the model.
        inference: time of one run of the model for one pose, outside of Blender's evaluation.
        constant_bytes: size of the constants of the model's graph, which each frame reads; 0 if unknown.
        model: path of the model, as its binding stores it.
    """

    rig: float
    linear: float
    fdda: float
    floor: float
    inference: float
    constant_bytes: int
    model: str

    @property
    def sentence(self) -> str:
        """Return a sentence that compares rig and model."""
        return compare_times(self.rig, self.fdda)


def compare_times(rig_ms: float, fdda_ms: float) -> str:
    """Return a sentence that compares rig and model, given their milliseconds per frame."""
    if fdda_ms >= rig_ms:
        return "Not worth it here: this rig is faster than the model."
    return f"{rig_ms / fdda_ms:.1f}x faster than the rig."


def store(mesh_object: bpy.types.Object, times: FrameTimes) -> None:
    """Store the frame times of an object with its bound model."""
    _frame_times[mesh_object.session_uid] = times


def get(mesh_object: bpy.types.Object) -> FrameTimes | None:
    """Return the frame times of an object with its bound model; None if they were not measured."""
    times = _frame_times.get(mesh_object.session_uid)
    return times if times and times.model == mesh_object.fdda.model else None


def remove(mesh_object: bpy.types.Object) -> None:
    """Remove the frame times of an object, because its model has changed."""
    _frame_times.pop(mesh_object.session_uid, None)
