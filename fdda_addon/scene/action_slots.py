# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the datablocks of a rig that an action animates, the slot of the action for each, and what its F-curves change.

A control rig is often another armature than the one that deforms the mesh. Constraints, drivers and other objects
connect them, and an action belongs on the datablocks for which it has F-curves.
"""

from collections.abc import Iterable, Iterator, Sequence

import bpy
import numpy as np

from ..core.errors import RigError
from ..core.mathematics.poses import LOCATION, ROTATION, SCALE
from .arrays import KEYFRAME_ELEMENTS, read
from .compatibility import accepts_slot, curves_of_slot

_COPY_CONSTRAINTS = {"COPY_LOCATION": LOCATION, "COPY_ROTATION": ROTATION, "COPY_SCALE": SCALE}

_IGNORED_PREFIXES = ("fdda.", "hide_")
"""Starts of paths that change what is shown, not its shape."""

_BONE_PREFIX = 'pose.bones["'

ActionSlots = dict[bpy.types.ID, "bpy.types.ActionSlot"]
"""Slots of an action, by the datablock that each animates."""

CurvesByDatablock = dict[bpy.types.ID, list[bpy.types.FCurve]]
"""Unmuted F-curves of an action, by the datablock that they animate."""


def dependencies(*roots: bpy.types.ID) -> list[bpy.types.ID]:
    """Return datablocks, and all that they depend on: through constraints, drivers, parents, modifiers and nodes.

    The datablocks of materials and the content of scenes are left out.
    """
    references: dict[bpy.types.ID, list[bpy.types.ID]] = {}
    for datablock, users in bpy.data.user_map().items():
        if not isinstance(datablock, bpy.types.Material):
            for user in users:
                references.setdefault(user, []).append(datablock)
    found = dict.fromkeys(roots)
    queue = list(found)
    for datablock in queue:
        if isinstance(datablock, bpy.types.Scene):
            continue
        # The linked original of a library override is not evaluated.
        linked = datablock.override_library.reference if datablock.override_library else None
        new = [other for other in references.get(datablock, ()) if other not in found and other != linked]
        found |= dict.fromkeys(new)
        queue += new
    return queue


def slots_of_action(action: bpy.types.Action, datablocks: Sequence[bpy.types.ID]) -> ActionSlots:
    """Choose the slots with which an action animates the datablocks of a rig.

    A slot animates the datablocks that use it now; else those that use a slot with the same identifier of another
    action, or that have the slot's name. A slot without such a datablock animates the one where most of its F-curves
    for bones, shape keys and other named items have an effect. What is muted, driven, or overridden by a constraint has
    no effect.

    Args:
        datablocks: the datablocks of the rig (`dependencies`).
    """
    slots: ActionSlots = {}
    curves = {slot: unmuted_curves(action, slot) for slot in action.slots}
    users = {slot: slot.users() for slot in action.slots}
    claims = (
        lambda slot, datablock: datablock in users[slot],
        lambda slot, datablock: slot.name_display != "Legacy Slot" and slot.identifier in _used_identifiers(datablock),
        lambda slot, datablock: slot.name_display == datablock.name,
    )
    remaining_slots = list(action.slots)
    for claim in claims:
        for slot in list(remaining_slots):
            animated = [
                datablock
                for datablock in datablocks
                if datablock not in slots
                and accepts_slot(datablock, slot)
                and claim(slot, datablock)
                and any(_curves_with_effect(datablock, curves[slot]))
            ]
            if animated:
                slots |= dict.fromkeys(animated, slot)
                remaining_slots.remove(slot)
    of_others = [slot for slot in remaining_slots if users[slot] or _named_object(slot) not in {None, *datablocks}]
    slots |= _fitting_slots(action, [s for s in remaining_slots if s not in of_others], curves, datablocks, slots)
    return slots or _fitting_slots(action, of_others, curves, datablocks, slots)


def may_animate(action: bpy.types.Action, datablocks: Sequence[bpy.types.ID]) -> bool:
    """Return whether an action may animate the datablocks of a rig, which takes less time than `slots_of_action`.

    It also returns True if drivers or constraints override all of its F-curves.
    """
    for slot in action.slots:
        users, accepted = set(slot.users()), [d for d in datablocks if accepts_slot(d, slot)]
        claimed = [d for d in accepted if d in users or d.name == slot.name_display]
        armature_objects = [d for d in accepted if not _is_not_armature(d)]
        others = [d for d in accepted if not isinstance(d, bpy.types.Object)]
        for curve in curves_of_slot(action, slot):
            path = curve.data_path
            if path.startswith(_BONE_PREFIX):
                candidates = armature_objects
            else:
                candidates = [*claimed, *armature_objects, *others] if "[" in path else claimed
            if any(_property_owner(d, path) is not None for d in candidates) and not path.startswith(_IGNORED_PREFIXES):
                return True
    return False


def unmuted_curves(action: bpy.types.Action, slot: "bpy.types.ActionSlot") -> list[bpy.types.FCurve]:
    """Return the F-curves of a slot that are not muted, neither themselves nor with their group."""
    curves = curves_of_slot(action, slot)
    return [curve for curve in curves if not (curve.mute or (curve.group and curve.group.mute))]


def constraint_actions(armature_object: bpy.types.Object) -> set[bpy.types.Action]:
    """Return the actions that only Action constraints of bones play."""
    constraints = (constraint for bone in armature_object.pose.bones for constraint in bone.constraints)
    actions = {c.action for c in constraints if c.type == "ACTION" and c.action is not None}
    animation = armature_object.animation_data
    if animation is not None:
        strips = (strip for track in animation.nla_tracks for strip in track.strips)
        actions -= {animation.action, *(strip.action for strip in strips)}
    return actions


def curves_of_actions(actions: Iterable[bpy.types.Action], *roots: bpy.types.ID) -> list[CurvesByDatablock]:
    """Return the F-curves with which each action animates datablocks and all that they depend on."""
    actions = list(actions)
    datablocks = dependencies(*roots) if actions else []
    return [
        {datablock: unmuted_curves(action, slot) for datablock, slot in slots_of_action(action, datablocks).items()}
        for action in actions
    ]


def active_action(armature_object: bpy.types.Object, mesh_object: bpy.types.Object) -> bpy.types.Action | None:
    """Return the active action of a rig: of its armature object, or else of the first datablock on which it depends."""
    return _playing_action(armature_object) or next(
        filter(None, map(_playing_action, sorted(dependencies(armature_object, mesh_object), key=_is_not_armature))),
        None,
    )


def _playing_action(datablock: bpy.types.ID) -> bpy.types.Action | None:
    """Return the active action of a datablock; None if it has no effect there."""
    animation = getattr(datablock, "animation_data", None)
    if animation is None or animation.action is None or animation.action_slot is None:
        return None
    curves = unmuted_curves(animation.action, animation.action_slot)
    return animation.action if any(_curves_with_effect(datablock, curves)) else None


def is_overridden(owner: "bpy.types.PoseBone | bpy.types.Object", kind: str) -> bool:
    """Return whether a constraint overrides the channels of `kind` of a bone or an object, such as `LOCATION`."""
    return any(
        constraint.type == "COPY_TRANSFORMS"
        or (
            _COPY_CONSTRAINTS.get(constraint.type) == kind
            and all((constraint.use_x, constraint.use_y, constraint.use_z))
            and not getattr(constraint, "use_offset", False)
        )
        for constraint in owner.constraints
        if not constraint.mute and constraint.influence == 1 and getattr(constraint, "mix_mode", "REPLACE") == "REPLACE"
    )


def _used_identifiers(datablock: bpy.types.ID) -> set[str]:
    """Return the identifiers of the slots that animate a datablock now."""
    animation = getattr(datablock, "animation_data", None)
    if animation is None:
        return set()
    owners = [animation, *(strip for track in animation.nla_tracks for strip in track.strips)]
    return {owner.action_slot.identifier for owner in owners if owner.action_slot is not None}


def _named_object(slot: "bpy.types.ActionSlot") -> bpy.types.ID | None:
    """Return the object, or the shape keys, with the name of a slot."""
    collection = {"OBJECT": bpy.data.objects, "KEY": bpy.data.shape_keys}.get(slot.target_id_type)
    return collection.get(slot.name_display) if collection is not None else None


def _fitting_slots(
    action: bpy.types.Action,
    candidates: Sequence["bpy.types.ActionSlot"],
    curves: "dict[bpy.types.ActionSlot, list[bpy.types.FCurve]]",
    datablocks: Sequence[bpy.types.ID],
    chosen: ActionSlots,
) -> ActionSlots:
    """Choose for each slot the datablock, besides those in `chosen`, where most of its F-curves have an effect."""
    slots: ActionSlots = {}
    for slot in candidates:
        # F-curves for bones, shape keys and other named items; only armature objects have bones.
        named_curves = [curve for curve in curves[slot] if "[" in curve.data_path]
        other_curves = [curve for curve in named_curves if not curve.data_path.startswith("pose.")]
        counts = {
            datablock: len(
                list(_curves_with_effect(datablock, other_curves if _is_not_armature(datablock) else named_curves))
            )
            for datablock in datablocks
            if datablock not in chosen and accepts_slot(datablock, slot)
        }
        largest_count = max(counts.values(), default=0)
        fitting = sorted((d for d, count in counts.items() if count == largest_count > 0), key=lambda d: d.name)
        if len(fitting) > 1:
            names = " or ".join(f"'{datablock.name}'" for datablock in fitting)
            raise RigError(
                f"The slot '{slot.identifier}' of the action '{action.name}' may be for {names}; assign the action to "
                "one of them, or rename the slot after it."
            )
        for datablock in fitting:
            if datablock in slots:
                raise RigError(
                    f"The slots '{slots[datablock].identifier}' and '{slot.identifier}' of the action '{action.name}' "
                    f"may both be for '{datablock.name}'; rename one of them after it."
                )
            slots[datablock] = slot
    return slots


def _curves_with_effect(datablock: bpy.types.ID, curves: Iterable[bpy.types.FCurve]) -> Iterator[bpy.types.FCurve]:
    """Yield the F-curves whose property a datablock has, unless a driver or a constraint overrides it."""
    animation = datablock.animation_data
    drivers = animation.drivers if animation else ()
    driven = {(driver.data_path, driver.array_index) for driver in drivers if not driver.mute}
    for curve in curves:
        path = curve.data_path
        if path.startswith(_IGNORED_PREFIXES) or (path, curve.array_index) in driven:
            continue
        owner, kind = _property_owner(datablock, path), path.rpartition(".")[2].partition("_")[0]
        is_transform = kind in {LOCATION, ROTATION, SCALE} and isinstance(owner, bpy.types.PoseBone | bpy.types.Object)
        if owner is not None and not (is_transform and is_overridden(owner, kind)):
            yield curve


def _property_owner(datablock: bpy.types.ID, path: str) -> bpy.types.bpy_struct | None:
    """Return the struct that has the property at a path of a datablock; None if there is no such property."""
    # Looking a name up takes a fraction of the time of a path that cannot be resolved.
    if path.startswith(_BONE_PREFIX) and "\\" not in path:
        bones = () if _is_not_armature(datablock) else datablock.pose.bones
        if path[len(_BONE_PREFIX) : path.find('"]')] not in bones:
            return None
    try:
        return datablock.path_resolve(path, False).data
    except (ValueError, AttributeError):
        return None


def _is_not_armature(datablock: bpy.types.ID) -> bool:
    return getattr(datablock, "type", "") != "ARMATURE"


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
