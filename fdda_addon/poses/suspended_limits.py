# SPDX-License-Identifier: GPL-3.0-or-later
"""Suspends limits: mutes Limit constraints while a pose exceeds them."""

from typing import Self

import bpy
import numpy as np

from ..core.mathematics.poses import Channel
from .motion_range import AXES, LIMIT_CONSTRAINT_TYPES


class SuspendedLimits:
    """Mutes Limit constraints in local space that a pose exceeds. As a context manager, it unmutes them at the end."""

    def __init__(self, armature_object: bpy.types.Object, channels: tuple[Channel, ...]):
        """Find the constraints that limit channels.

        Args:
            armature_object: the armature object with the bones.
            channels: C channels of the poses.
        """
        channel_indices: dict[tuple[str, str], list[int]] = {}
        """Indices of channels by the name of the bone and the type of the constraint."""
        for index, channel in enumerate(channels):
            if channel.kind in LIMIT_CONSTRAINT_TYPES:
                channel_indices.setdefault((channel.name, LIMIT_CONSTRAINT_TYPES[channel.kind]), []).append(index)
        self._limits = [
            (
                constraint,
                limited_channels,
                *_limits_of_axes(constraint, [channels[index].axis for index in limited_channels]),
            )
            for (name, constraint_type), limited_channels in channel_indices.items()
            for constraint in armature_object.pose.bones[name].constraints
            if constraint.type == constraint_type
            and constraint.owner_space == "LOCAL"
            and constraint.influence > 0
            and not constraint.mute
        ]

    def suspend(self, values: np.ndarray) -> None:
        """Mute the constraints that the (C,) channel values exceed, and unmute the others."""
        for constraint, limited_channels, low, high in self._limits:
            limited_values = values[limited_channels]
            is_exceeded = bool(((limited_values < low) | (limited_values > high)).any())
            if constraint.mute != is_exceeded:
                constraint.mute = is_exceeded

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for constraint, *_ in self._limits:
            constraint.mute = False


def _limits_of_axes(constraint: bpy.types.Constraint, axes: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper limits of a constraint for n axes, (n,) each; infinite where it has none."""
    bounds = []
    for side, infinite_value in (("min", -np.inf), ("max", np.inf)):
        limits = []
        for letter in (AXES[axis] for axis in axes):
            # Limit Rotation has one switch for both sides of an axis.
            switch_name = (
                f"use_limit_{letter}" if hasattr(constraint, f"use_limit_{letter}") else f"use_{side}_{letter}"
            )
            limits.append(
                getattr(constraint, f"{side}_{letter}") if getattr(constraint, switch_name) else infinite_value
            )
        bounds.append(np.array(limits))
    return bounds[0], bounds[1]
