# SPDX-License-Identifier: GPL-3.0-or-later
"""What a frame of each mesh object took when it was last measured, for the sidebar; it lasts for the session."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import bpy

if TYPE_CHECKING:  # Blender starts without numpy.
    from .benchmark import Benchmark

_kept: dict[int, "FrameTimes"] = {}


@dataclass(frozen=True)
class FrameTimes:
    """Milliseconds a frame, medians: of the rig, its Armature modifier alone, and the model; the model's file."""

    rig: float
    linear: float
    fdda: float
    model: str

    @property
    def sentence(self) -> str:
        """What the times mean."""
        if self.fdda >= self.rig:
            return "Not worth it here: the modifiers of this rig cost less than the playback of a model."
        return f"FDDA is {self.rig / self.fdda:.1f} times as fast as the rig."


def keep(mesh_object: bpy.types.Object, measured: "Benchmark") -> FrameTimes:
    """Note what was measured with the bound model."""
    times = (sorted(getattr(measured, way))[len(getattr(measured, way)) // 2] for way in ("rig", "linear", "fdda"))
    _kept[mesh_object.session_uid] = FrameTimes(*times, mesh_object.fdda.model)
    return _kept[mesh_object.session_uid]


def of(mesh_object: bpy.types.Object) -> FrameTimes | None:
    """The times with the model that is bound now, None when nothing was measured."""
    times = _kept.get(mesh_object.session_uid)
    return times if times and times.model == mesh_object.fdda.model else None
