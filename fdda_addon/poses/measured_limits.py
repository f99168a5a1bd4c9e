# SPDX-License-Identifier: GPL-3.0-or-later
"""Sets the ranges of motion of a rig from the ranges in which actions move its bones, without changing its poses."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import bpy

from ..core.errors import RigError
from ..core.mathematics.poses import LOCATION, RANGE_TOLERANCE, ROTATION, ROTATION_VECTOR, SCALE
from ..scene.action_slots import curves_of_actions
from ..scene.scene_rig import SceneRig
from ..scene.unit import metres_per_unit
from .action_range import has_width, keyed_ranges, moving_ranges
from .motion_range import (
    AXES,
    DEFAULT,
    LIMIT_CONSTRAINT_TYPES,
    enforced_range,
    ensure_range_constraint,
    find_local_limit,
    rotation_ranges,
    set_constraint_limit,
    set_rotation_range,
)

DEFAULT_MARGIN = 0.1
"""Fraction of the width of a measured range that is added at each end."""

MAX_WIDENING = 1.5
"""Ratio of the ranges of Euler angles to those of rotation vectors above which a motion is near gimbal lock."""

GIMBAL_LOCK_NOTE = "; wider than it rotates, as it comes near gimbal lock: sample the action itself, not these ranges"
_VERBS_AND_UNITS = {ROTATION: ("turns", "°", 1), LOCATION: ("moves", " mm", 1), SCALE: ("scales", "", 2)}
"""Verb, unit and number of digits by kind of channel."""


@dataclass(frozen=True)
class MeasuredLimit:
    """The range of one axis of a bone that the actions move.

    Attributes:
        bone, kind, axis: as in `Channel`.
        low, high: the range that was set, or the measured range if none was set; radians, meters or factors.
        reason_unset: the reason why the range was not set; empty if it was set.
        near_gimbal_lock: the bone rotates much less than the ranges of its Euler angles allow (`MAX_WIDENING`).
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
    """Set the ranges of motion of a rig from actions.

    Rotations are stored as IK limits if these can express them and no IK solver uses them. All other ranges are stored
    in Limit constraints with an influence of 0, so the poses of the rig do not change. An enforced limit is kept
    and bounds the range. Locked axes stay locked, and axes that the actions do not move keep their range. If a Limit
    Rotation constraint is added, it fixes the other axes that have no range, because they would get the default range
    otherwise.

    Args:
        margin: fraction of the width of each range that is added at each end.

    Returns:
        The axes that the actions move or hold at a constant rotation other than rest, in the order of the bones.

    Raises:
        RigError: the actions move no bone of the rig, or the rig is linked and cannot be changed.
    """
    armature_object, actions = scene_rig.armature_object, list(actions)
    if armature_object.library is not None:
        raise RigError(
            f"'{armature_object.name}' is linked and its limits belong to another file; set them there, or give it a "
            "library override."
        )
    keyed_channel_ranges = keyed_ranges(armature_object, actions)
    moving_channel_ranges = moving_ranges(keyed_channel_ranges)
    held_rotations = {
        key: bounds
        for key, bounds in keyed_channel_ranges.items()
        if key[1] == ROTATION and (not has_width(bounds) and abs(bounds[0]) > RANGE_TOLERANCE)
    }
    if not moving_channel_ranges:
        names = ", ".join(f"'{action.name}'" for action in actions) or "none"
        animated = {d.name for curves in curves_of_actions(actions, armature_object) for d in curves}
        others = " and ".join(f"'{name}'" for name in sorted(animated - {armature_object.name}))
        remedy = f"they animate {others}" if others else "choose actions of this rig"
        raise RigError(f"The actions ({names}) move no bone of '{armature_object.name}'; {remedy}.")
    widths: dict[tuple[str, str], float] = {}
    for (bone, kind, _), (low, high) in keyed_channel_ranges.items():
        widths[bone, kind] = widths.get((bone, kind), 0.0) + high - low
    rotation_vector_widths = [(bone, width) for (bone, kind), width in widths.items() if kind == ROTATION_VECTOR]
    bones_near_gimbal_lock = {
        bone
        for bone, width in rotation_vector_widths
        if widths[bone, ROTATION] > MAX_WIDENING * width + RANGE_TOLERANCE
    }
    # An IK solver uses the limits of any bone that it moves.
    has_ik = any(constraint.type == "IK" for bone in armature_object.pose.bones for constraint in bone.constraints)
    all_limits: list[MeasuredLimit] = []
    for bone in armature_object.pose.bones:
        bone_ranges = {
            key[1:]: bounds for key, bounds in (moving_channel_ranges | held_rotations).items() if key[0] == bone.name
        }
        limits = [
            _measured_limit(bone, *kind_axis, bounds, margin) for kind_axis, bounds in sorted(bone_ranges.items())
        ]
        _set_limits(bone, limits, has_ik)
        for limit in limits:
            is_near = bone.name in bones_near_gimbal_lock and limit.kind == ROTATION
            all_limits.append(replace(limit, near_gimbal_lock=is_near))
    return tuple(all_limits)


def _set_limits(bone: bpy.types.PoseBone, limits: list[MeasuredLimit], has_ik: bool) -> None:
    """Set the limits of a bone that can be set, as IK limits or in constraints."""
    for kind in (ROTATION, LOCATION, SCALE):
        settable_limits = [limit for limit in limits if limit.kind == kind and not limit.reason_unset]
        has_constraint = find_local_limit(bone, LIMIT_CONSTRAINT_TYPES[kind]) is not None
        if (
            kind == ROTATION
            and not has_ik
            and not has_constraint
            and all(-math.pi <= limit.low <= 0 <= limit.high <= math.pi for limit in settable_limits)
        ):
            for limit in settable_limits:
                set_rotation_range(bone, limit.axis, limit.low, limit.high)
        elif settable_limits:
            _set_range_constraint(bone, kind, settable_limits)


def _measured_limit(
    bone: bpy.types.PoseBone, kind: str, axis: int, bounds: tuple[float, float], margin: float
) -> MeasuredLimit:
    """Compute the range to set for an axis, or the reason not to set it."""
    if not has_width(bounds):
        return MeasuredLimit(bone.name, kind, axis, *bounds, "constant and not at rest, so it gets no range")
    low, high = bounds
    margin_width = (high - low) * margin
    # Positive scales stay positive, because a scale of zero has no inverse.
    low, high = (
        low - margin_width if kind != SCALE or low <= 0 else max(low - margin_width, low / 2),
        high + margin_width,
    )
    if kind == ROTATION:
        is_locked = rotation_ranges(bone)[axis].is_locked
    else:
        is_locked = (bone.lock_location if kind == LOCATION else bone.lock_scale)[axis]
    if is_locked:
        return MeasuredLimit(bone.name, kind, axis, *bounds, "locked, left so")
    if kind == LOCATION and bone.bone.use_connect:
        return MeasuredLimit(bone.name, kind, axis, *bounds, "connected, cannot move")
    enforced_low, enforced_high = enforced_range(bone, LIMIT_CONSTRAINT_TYPES[kind], axis)
    low, high = max(low, enforced_low), min(high, enforced_high)
    if not low < high:
        return MeasuredLimit(bone.name, kind, axis, *bounds, "held by its limit, left so")
    return MeasuredLimit(bone.name, kind, axis, low, high)


def _set_range_constraint(bone: bpy.types.PoseBone, kind: str, limits: list[MeasuredLimit]) -> None:
    constraint = ensure_range_constraint(bone, LIMIT_CONSTRAINT_TYPES[kind])
    for limit in limits:
        set_constraint_limit(constraint, limit.axis, limit.low, limit.high)
    if kind == ROTATION:
        for axis, rotation_range in enumerate(rotation_ranges(bone)):
            if rotation_range.source == DEFAULT and not rotation_range.is_locked:
                set_constraint_limit(constraint, axis, 0.0, 0.0)


def describe_limits(armature_object: bpy.types.Object, limits: Iterable[MeasuredLimit]) -> list[str]:
    """Describe the limits with one line per bone, in degrees and millimeters."""
    factors = {ROTATION: 180 / math.pi, LOCATION: 1000 * metres_per_unit(armature_object), SCALE: 1.0}
    limits, descriptions_by_bone = list(limits), dict[str, list[str]]()
    for limit in limits:
        (verb, unit, digits), factor = _VERBS_AND_UNITS[limit.kind], factors[limit.kind]
        # Adding zero turns -0 into 0.
        low, high = (round(bound * factor, digits) + 0.0 for bound in (limit.low, limit.high))
        bounds = f"{low:.{digits}f} to {high:.{digits}f}{unit}"
        reason = f" ({limit.reason_unset})" if limit.reason_unset else ""
        descriptions_by_bone.setdefault(limit.bone, []).append(f"{verb} {AXES[limit.axis].upper()} {bounds}{reason}")
    bones_near_gimbal_lock = {limit.bone for limit in limits if limit.near_gimbal_lock}
    return [
        f"{bone}: {', '.join(descriptions)}{GIMBAL_LOCK_NOTE if bone in bones_near_gimbal_lock else ''}"
        for bone, descriptions in descriptions_by_bone.items()
    ]
