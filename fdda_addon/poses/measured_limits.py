# SPDX-License-Identifier: GPL-3.0-or-later
"""Limits set from actions: how far they move each bone becomes its range of motion. The rig poses as before."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import bpy

from ..core.errors import RigError
from ..core.poses import LOCATION, RANGE_TOLERANCE, ROTATION, ROTATION_VECTOR, SCALE
from ..scene.scene_rig import SceneRig
from ..scene.unit import metres_per_unit
from .action_range import Ranges, has_width, keyed_ranges, moving_ranges
from .motion_range import (
    AXES,
    DEFAULT,
    enforced_range,
    ensure_range_constraint,
    find_local_limit,
    rotation_ranges,
    set_constraint_limit,
    set_rotation_range,
)

DEFAULT_MARGIN = 0.1
"""Part of the width of a measured range that is added at each end."""

MAX_WIDENING = 1.5
"""Angles about X, Y and Z that are together wider than the rotations by this factor are near gimbal lock."""

LIMIT_OF = {ROTATION: "LIMIT_ROTATION", LOCATION: "LIMIT_LOCATION", SCALE: "LIMIT_SCALE"}
WIDE_NOTE = "; wider than it rotates, as it comes near gimbal lock: sample the action itself, not these ranges"
_WORDS = {ROTATION: ("turns", "°", 1), LOCATION: ("moves", " mm", 1), SCALE: ("scales", "", 2)}


@dataclass(frozen=True)
class MeasuredLimit:
    """One axis of a bone that the actions move.

    Attributes:
        bone, kind, axis: as of `Channel`.
        low, high: radians, metres or factors; the range that is stated now.
        reason_unset: why it was left as it was; empty when it is stated.
        near_gimbal_lock: the bone rotates less far than its three Euler angles do (`MAX_WIDENING`).
    """

    bone: str
    kind: str
    axis: int
    low: float
    high: float
    reason_unset: str = ""
    near_gimbal_lock: bool = False


def set_limits_from_actions(
    scene_rig: SceneRig, actions: Iterable[bpy.types.Action], margin: float = DEFAULT_MARGIN
) -> tuple[MeasuredLimit, ...]:
    """Make what actions do the range of motion of a rig.

    Rotations are stated as IK limits where these can say them and no IK solver reads them, everything else in a Limit
    constraint of influence 0: the rig poses as before. A limit that holds a bone stays, and the range ends where it
    does. Locked axes stay locked, and what the actions do not move keeps its range: that they leave it still is no
    reason that others may not move it. Only where a constraint is made are the other axes of a rotation that had no
    range stated as still, since the bone would turn about them by the default range otherwise.

    Args:
        scene_rig: the rig.
        actions: the actions.
        margin: part of the width of each range that is added at each end.

    Returns:
        What the actions move, and which axes they rotate and hold, in the order of the bones.

    Raises:
        RigError: the actions move no bone of the rig, or it is linked and cannot be changed.
    """
    armature_object, actions = scene_rig.armature_object, list(actions)
    if armature_object.library is not None:
        raise RigError(
            f"'{armature_object.name}' is linked and its limits belong to another file; set them there, or give it a "
            "library override."
        )
    keyed = keyed_ranges(armature_object, actions)
    measured = moving_ranges(keyed)
    still = {key: bounds for key, bounds in keyed.items() if key[1] == ROTATION and _stands_away(bounds)}
    if not measured:
        names = ", ".join(f"'{action.name}'" for action in actions) or "none"
        raise RigError(f"The actions ({names}) move no bone of '{armature_object.name}'; choose actions of this rig.")
    wide = _wide_bones(keyed)
    # An IK solver would take the limits of any bone that it moves.
    has_ik = any(constraint.type == "IK" for bone in armature_object.pose.bones for constraint in bone.constraints)
    found: list[MeasuredLimit] = []
    for bone in armature_object.pose.bones:
        own = {key[1:]: bounds for key, bounds in (measured | still).items() if key[0] == bone.name}
        limits = [_limit(bone, kind, axis, bounds, margin) for (kind, axis), bounds in sorted(own.items())]
        for kind in (ROTATION, LOCATION, SCALE):
            stated = [limit for limit in limits if limit.kind == kind and not limit.reason_unset]
            if kind == ROTATION and not has_ik and find_local_limit(bone, LIMIT_OF[kind]) is None and _fit_ik(stated):
                for limit in stated:
                    set_rotation_range(bone, limit.axis, limit.low, limit.high)
            elif stated:
                _state_without_holding(bone, kind, stated)
        found += [replace(limit, near_gimbal_lock=bone.name in wide and limit.kind == ROTATION) for limit in limits]
    return tuple(found)


def _wide_bones(keyed: Ranges) -> set[str]:
    """Bones whose ranges of Euler angles let them rotate much farther than the actions do."""
    widths: dict[tuple[str, str], float] = {}
    for (bone, kind, _), (low, high) in keyed.items():
        widths[bone, kind] = widths.get((bone, kind), 0.0) + high - low
    vectors = [(bone, width) for (bone, kind), width in widths.items() if kind == ROTATION_VECTOR]
    return {bone for bone, width in vectors if widths[bone, ROTATION] > MAX_WIDENING * width + RANGE_TOLERANCE}


def _stands_away(bounds: tuple[float, float]) -> bool:
    """Whether a rotation stands still elsewhere than in the rest pose."""
    return not has_width(bounds) and abs(bounds[0]) > RANGE_TOLERANCE


def _limit(bone: bpy.types.PoseBone, kind: str, axis: int, bounds: tuple[float, float], margin: float) -> MeasuredLimit:
    """What is to be stated of an axis."""
    if not has_width(bounds):
        return MeasuredLimit(bone.name, kind, axis, *bounds, "stands still away from rest, has no range")
    low, high = bounds
    added = (high - low) * margin
    # A scale of zero has no inverse.
    low, high = low - added if kind != SCALE or low <= 0 else max(low - added, low / 2), high + added
    if kind == ROTATION:
        is_locked = rotation_ranges(bone)[axis].is_locked
    else:
        is_locked = (bone.lock_location if kind == LOCATION else bone.lock_scale)[axis]
    if is_locked:
        return MeasuredLimit(bone.name, kind, axis, *bounds, "locked, left so")
    if kind == LOCATION and bone.bone.use_connect:
        return MeasuredLimit(bone.name, kind, axis, *bounds, "connected, cannot move")
    least, most = enforced_range(bone, LIMIT_OF[kind], axis)
    low, high = max(low, least), min(high, most)
    if not low < high:
        return MeasuredLimit(bone.name, kind, axis, *bounds, "held by its limit, left so")
    return MeasuredLimit(bone.name, kind, axis, low, high)


def _fit_ik(limits: list[MeasuredLimit]) -> bool:
    """Whether IK limits can say ranges: they hold the rest pose and go no farther than half a turn."""
    return all(-math.pi <= limit.low <= 0 <= limit.high <= math.pi for limit in limits)


def _state_without_holding(bone: bpy.types.PoseBone, kind: str, limits: list[MeasuredLimit]) -> None:
    constraint = ensure_range_constraint(bone, LIMIT_OF[kind])
    for limit in limits:
        set_constraint_limit(constraint, limit.axis, limit.low, limit.high)
    if kind == ROTATION:
        for axis, r in enumerate(rotation_ranges(bone)):
            if r.source == DEFAULT and not r.is_locked:
                set_constraint_limit(constraint, axis, 0.0, 0.0)


def describe_limits(armature_object: bpy.types.Object, limits: Iterable[MeasuredLimit]) -> list[str]:
    """A line for each bone, in degrees and millimetres."""
    factors = {ROTATION: 180 / math.pi, LOCATION: 1000 * metres_per_unit(armature_object), SCALE: 1.0}
    limits, by_bone = list(limits), dict[str, list[str]]()
    for limit in limits:
        (verb, unit, digits), factor = _WORDS[limit.kind], factors[limit.kind]
        # Adding zero makes -0 a 0.
        low, high = (round(end * factor, digits) + 0.0 for end in (limit.low, limit.high))
        ends = f"{low:.{digits}f} to {high:.{digits}f}{unit}"
        reason_unset = f" ({limit.reason_unset})" if limit.reason_unset else ""
        by_bone.setdefault(limit.bone, []).append(f"{verb} {AXES[limit.axis].upper()} {ends}{reason_unset}")
    wide = {limit.bone for limit in limits if limit.near_gimbal_lock}
    return [f"{bone}: {', '.join(texts)}{WIDE_NOTE if bone in wide else ''}" for bone, texts in by_bone.items()]
