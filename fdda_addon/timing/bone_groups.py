# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the bones whose constraints and drivers take the most time, by removing groups of them from copies.

Thousands of bones cannot be timed one by one. The group that takes the most time is divided, until the groups are
single bones or too small to measure.
"""

import statistics
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import bpy

from ..core.progress import Job, Progress
from ..rig.references import split_bone_path
from .durations import TEMPORARY_SCENE_NAME, Duration, frame_ms, temporary_scene

MAX_GROUPS = 10
MAX_MEASUREMENTS = 40
"""Largest number of groups that are measured."""
ROUNDS, FRAMES_PER_ROUND = 3, 8
MIN_GROUP_MS = 0.02
"""A group that takes less time is not divided."""
NO_BONE = ""
"""Key of the drivers of the armature object and its data that belong to no bone."""
RemovablePart = bpy.types.Constraint | bpy.types.FCurve


@dataclass(frozen=True)
class BoneGroup:
    """Bones that follow each other in the armature, with their constraints and drivers.

    Attributes:
        bones: names of the bones; `NO_BONE` stands for properties of the armature.
        constraints, drivers: numbers of enabled constraints and drivers.
        duration: time that the constraints and drivers take, ms.
    """

    bones: tuple[str, ...]
    constraints: int
    drivers: int
    duration: Duration

    @property
    def title(self) -> str:
        """Return the description of the group for users."""
        names = [name for name in self.bones if name]
        if not names:
            subject = "Properties"
        elif len(names) == 1:
            subject = names[0]
        else:
            subject = f"{names[0]} to {names[-1]}, {len(names)} bones"
        counts = [(self.constraints, "constraint"), (self.drivers, "driver")]
        texts = [f"{count} {noun}{'' if count == 1 else 's'}" for count, noun in counts if count]
        return f"{subject}: {', '.join(texts)}"

    def to_json(self) -> dict:
        """Return the group as JSON."""
        return {
            "bones": list(self.bones),
            "constraints": self.constraints,
            "drivers": self.drivers,
            "duration": self.duration.to_json(),
        }


def find_expensive_groups(armature_object: bpy.types.Object, frames: range) -> Job[tuple[BoneGroup, ...]]:
    """Find the bones of an armature whose constraints and drivers take the most time.

    Args:
        frames: frames of its animation.

    Yields:
        Progress of the stage "bones".

    Returns:
        At most `MAX_GROUPS` groups, largest first.
    """
    parts = parts_by_bone(armature_object)
    if not parts:
        return ()
    measured_count, groups = 0, []
    with armature_copy(armature_object) as full_scene:

        def measure(names: Iterable[str]) -> Job[BoneGroup]:
            nonlocal measured_count
            group = [part for name in names for part in parts[name]]
            rounds, ratios = [], []
            with armature_copy(armature_object, group) as scene:
                for round_index in range(ROUNDS):
                    first_index = round_index * FRAMES_PER_ROUND
                    rounds.append(frame_ms(full_scene, frames, first_index, FRAMES_PER_ROUND))
                    ratios.append(1 - frame_ms(scene, frames, first_index, FRAMES_PER_ROUND) / rounds[-1])
            full_ms = statistics.median(rounds)
            driver_count = sum(isinstance(part, bpy.types.FCurve) for part in group)
            duration = Duration.of([ratio * full_ms for ratio in ratios])
            measured_count += 1
            yield Progress("bones", measured_count, MAX_MEASUREMENTS)
            return BoneGroup(tuple(names), len(group) - driver_count, driver_count, duration)

        # Divide the group that takes the most time first.
        queue = [(yield from measure(parts))]
        while queue:
            queue.sort(key=lambda group: group.duration.median)
            group = queue.pop()
            halves = []
            if len(group.bones) > 1 and group.duration.median > MIN_GROUP_MS and measured_count + 2 <= MAX_MEASUREMENTS:
                middle = len(group.bones) // 2
                for names in (group.bones[:middle], group.bones[middle:]):
                    halves.append((yield from measure(names)))
            # A half within the noise says nothing. If both are, the group stays whole.
            if clear_halves := [half for half in halves if half.duration.is_clear]:
                queue += clear_halves
            elif group.duration.is_clear:
                groups.append(group)
    yield Progress("bones", MAX_MEASUREMENTS, MAX_MEASUREMENTS)
    return tuple(sorted(groups, key=lambda group: -group.duration.median)[:MAX_GROUPS])


def parts_by_bone(armature_object: bpy.types.Object) -> dict[str, list[RemovablePart]]:
    """Return the enabled constraints and drivers of an armature by the name of the bone, in the order of the bones."""
    parts: dict[str, list[RemovablePart]] = {bone.name: [] for bone in armature_object.pose.bones}
    for bone in armature_object.pose.bones:
        parts[bone.name] += [constraint for constraint in bone.constraints if not constraint.mute]
    for datablock in (armature_object, armature_object.data):
        animation = datablock.animation_data
        for curve in animation.drivers if animation else ():
            if not curve.mute:
                bone_name, _ = split_bone_path(datablock, curve.data_path)
                parts.setdefault(bone_name if bone_name in parts else NO_BONE, []).append(curve)
    return {name: bone_parts for name, bone_parts in parts.items() if bone_parts}


@contextmanager
def armature_copy(
    armature_object: bpy.types.Object, removed: Iterable[RemovablePart] = ()
) -> Iterator[bpy.types.Scene]:
    """Create a scene with a copy of an armature object alone, and what its bones depend on; remove both afterwards.

    The copy depends on itself where the original depends on itself, and plays the same action.

    Args:
        removed: constraints of its bones, and drivers of it and of its armature, that the copy lacks.
    """
    constraint_names: dict[str, set[str]] = {}
    driver_keys: set[tuple[bpy.types.ID, str, int]] = set()
    for part in removed:
        if isinstance(part, bpy.types.FCurve):
            driver_keys.add((part.id_data, part.data_path, part.array_index))
        else:
            bone_name = part.path_from_id().partition(".constraints[")[0]
            constraint_names.setdefault(bone_name, set()).add(part.name)
    copies: list[bpy.types.ID] = []
    try:
        copy = _local_copy(armature_object, copies)
        copy.data = _local_copy(armature_object.data, copies)
        copy.hide_viewport = False
        for original, copied in ((armature_object, copy), (armature_object.data, copy.data)):
            drivers = copied.animation_data.drivers if copied.animation_data else ()
            for curve in list(drivers):
                if (original, curve.data_path, curve.array_index) in driver_keys:
                    drivers.remove(curve)
        for bone_path, names in constraint_names.items():
            constraints = copy.path_resolve(bone_path).constraints
            for name in names:
                constraints.remove(constraints[name])
        _point_to_copies(copy, {armature_object: copy, armature_object.data: copy.data})
        with temporary_scene([copy]) as scene:
            yield scene
    finally:
        bpy.data.batch_remove(copies)


def _local_copy(datablock: bpy.types.ID, copies: list[bpy.types.ID]) -> bpy.types.ID:
    """Copy a datablock, which may be linked or a library override, and append the copy to `copies`."""
    copy = datablock.copy()
    copies.append(copy)
    copy.name = TEMPORARY_SCENE_NAME
    if copy.override_library is not None:
        copy.make_local(clear_liboverride=True)
    return copy


def _point_to_copies(copy: bpy.types.Object, copies: dict[bpy.types.ID, bpy.types.ID]) -> None:
    """Replace the originals by the copies in all constraints and drivers of the copies."""
    for bone in copy.pose.bones:
        for constraint in bone.constraints:
            for struct in (constraint, *getattr(constraint, "targets", ())):
                for name in ("target", "pole_target", "space_object"):
                    value = getattr(struct, name, None)
                    if value in copies:
                        setattr(struct, name, copies[value])
    for owner in copies.values():
        for curve in owner.animation_data.drivers if owner.animation_data else ():
            for variable in curve.driver.variables:
                for target in variable.targets:
                    if target.id in copies:
                        target.id = copies[target.id]
