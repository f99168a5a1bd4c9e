# SPDX-License-Identifier: GPL-3.0-or-later
"""Limit constraints that are off while a rig shows a pose that they would hold back."""

from typing import Self

import bpy
import numpy as np

from ..core.poses import LOCATION, ROTATION, SCALE, Channel
from .motion_range import AXES

KINDS = {ROTATION: "LIMIT_ROTATION", LOCATION: "LIMIT_LOCATION", SCALE: "LIMIT_SCALE"}


class SuspendedLimits:
    """Switches Limit constraints in local space off, pose by pose; use as a context manager, which gives them back."""

    def __init__(self, armature_object: bpy.types.Object, channels: tuple[Channel, ...]):
        """Args:
        armature_object: whose bones have the constraints.
        channels: of the poses.
        """
        places: dict[tuple[str, str], list[int]] = {}
        for place, channel in enumerate(channels):
            if channel.kind in KINDS:
                places.setdefault((channel.name, KINDS[channel.kind]), []).append(place)
        self._held = [
            (constraint, own, *_bounds(constraint, [channels[place].axis for place in own]))
            for (name, kind), own in places.items()
            for constraint in armature_object.pose.bones[name].constraints
            if constraint.type == kind
            and constraint.owner_space == "LOCAL"
            and constraint.influence > 0
            and not constraint.mute
        ]

    def suspend(self, values: np.ndarray) -> None:
        """Let these values of the channels stand: what would hold one of them is off, all else is on."""
        for constraint, own, low, high in self._held:
            reached = values[own]
            mute = bool(((reached < low) | (reached > high)).any())
            if constraint.mute != mute:
                constraint.mute = mute

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for constraint, *_others in self._held:
            constraint.mute = False


def _bounds(constraint: bpy.types.Constraint, axes: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """What a constraint leaves of each of some axes; infinite where it does not hold them."""
    ends = []
    for end, without in (("min", -np.inf), ("max", np.inf)):
        found = []
        for letter in (AXES[axis] for axis in axes):
            # Limit Rotation switches both ends of an axis at once.
            use = f"use_limit_{letter}" if hasattr(constraint, f"use_limit_{letter}") else f"use_{end}_{letter}"
            found.append(getattr(constraint, f"{end}_{letter}") if getattr(constraint, use) else without)
        ends.append(np.array(found))
    return ends[0], ends[1]
