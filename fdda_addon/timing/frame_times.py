# SPDX-License-Identifier: GPL-3.0-or-later
"""What a frame of each mesh object took when it was last measured, for the sidebar; it lasts for the session."""

from dataclasses import dataclass

import bpy

_frame_times: dict[int, "FrameTimes"] = {}


@dataclass(frozen=True)
class FrameTimes:
    """What a frame takes, medians in milliseconds.

    Attributes:
        rig: with all modifiers of the rig. linear: with its Armature modifier alone. fdda: with the model.
        floor: as fdda, with a model that costs nothing: Blender's part.
        inference: the model alone, one pose.
        constant_bytes: that the model reads in a frame; 0 where it does not say.
        model: the model's file.
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
        """Whether the model pays."""
        return verdict(self.rig, self.fdda)


def verdict(rig: float, fdda: float) -> str:
    """Whether a model pays that takes so many milliseconds a frame in place of the rig's."""
    if fdda >= rig:
        return "Not worth it here: this rig is faster than the model."
    return f"{rig / fdda:.1f}x faster than the rig."


def store(mesh_object: bpy.types.Object, times: FrameTimes) -> None:
    """Note what was measured with the bound model."""
    _frame_times[mesh_object.session_uid] = times


def get(mesh_object: bpy.types.Object) -> FrameTimes | None:
    """The times with the model that is bound now, None when nothing was measured."""
    times = _frame_times.get(mesh_object.session_uid)
    return times if times and times.model == mesh_object.fdda.model else None
