# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the F-curves that animate a datablock, and whether they change its properties."""

from collections.abc import Iterable, Iterator

import bpy
import numpy as np

from .action_slots import CurvesByDatablock
from .arrays import KEYFRAME_ELEMENTS, read
from .compatibility import curves_of_slot

MIN_VALUE_CHANGE = 1e-6
"""Keyframes whose values differ by no more than this count as equal."""


def active_curves(datablock: bpy.types.ID) -> list[bpy.types.FCurve]:
    """Find the F-curves that animate a datablock: the unmuted F-curves of its action and of its NLA strips."""
    animation = datablock.animation_data
    if animation is None:
        return []
    owners = [animation]
    if animation.use_nla:
        tracks = [track for track in animation.nla_tracks if track.is_solo] or animation.nla_tracks
        owners += [strip for track in tracks if not track.mute for strip in _unmuted_strips(track.strips)]
    actions_and_slots = [(owner.action, owner.action_slot) for owner in owners]
    curves = [curve for action, slot in actions_and_slots if action and slot for curve in curves_of_slot(action, slot)]
    return [curve for curve in curves if not curve.mute]


def _unmuted_strips(strips: Iterable[bpy.types.NlaStrip]) -> Iterator[bpy.types.NlaStrip]:
    """Yield the unmuted strips, with those inside of meta strips."""
    for strip in strips:
        if not strip.mute:
            yield strip
            yield from _unmuted_strips(strip.strips)


def curves_with_actions(
    datablock: bpy.types.ID, curves_by_action: Iterable[CurvesByDatablock]
) -> list[bpy.types.FCurve]:
    """Find the F-curves that animate a datablock, and those with which actions would animate it."""
    return [*active_curves(datablock), *(curve for curves in curves_by_action for curve in curves.get(datablock, ()))]


def changes_value(curve: bpy.types.FCurve) -> bool:
    """Return whether the value of an F-curve changes, judging by its keyframes, samples and modifiers."""
    if any(not modifier.mute for modifier in curve.modifiers) or len(curve.sampled_points):
        return True
    keyframes = curve.keyframe_points
    if len(keyframes) < 2 and curve.extrapolation == "CONSTANT":
        return False
    values = np.concatenate(
        [read(keyframes, element).reshape(len(keyframes), -1)[:, 1] for element in KEYFRAME_ELEMENTS[:3]]
    )
    return bool(len(keyframes)) and float(np.ptp(values)) > MIN_VALUE_CHANGE


def value_range(curve: bpy.types.FCurve) -> tuple[float, float]:
    """Return the lowest and highest value of an F-curve at its whole frames."""
    first_frame, last_frame = curve.range()
    values = [curve.evaluate(frame) for frame in range(int(first_frame), int(last_frame) + 1)]
    return min(values), max(values)
