# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the bones whose constraints and drivers take the most time, by muting groups of them and restoring them.

Thousands of bones cannot be timed one by one. The group that takes the most time is divided, until the groups are
single bones or too small to measure.
"""

import statistics
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import bpy

from ..core.progress import Progress
from ..rig.sources import split_bone_path
from .durations import Duration, scene_times

MAX_GROUPS = 10
MAX_MEASUREMENTS = 40
"""Largest number of groups that are measured."""
ROUNDS, FRAMES_PER_ROUND = 3, 8
MIN_GROUP_MS = 0.02
"""A group that takes less time is not divided."""
NO_BONE = ""
"""Key of the drivers of the armature object and its data that belong to no bone."""


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


Mutable = bpy.types.Constraint | bpy.types.FCurve


def find_expensive_groups(
    armature_object: bpy.types.Object, scene: bpy.types.Scene, frames: range
) -> Generator[Progress, None, tuple[BoneGroup, ...]]:
    """Find the bones of an armature whose constraints and drivers take the most time.

    Args:
        armature_object: the armature object.
        scene: a scene with the armature object alone.
        frames: frames of its animation.

    Yields:
        Progress of the stage "bones".

    Returns:
        At most `MAX_GROUPS` groups, largest first.
    """
    mutables = mutables_by_bone(armature_object)
    if not mutables:
        return ()
    measured_count = 0

    def measure(names: Iterable[str]) -> Generator[Progress, None, BoneGroup]:
        nonlocal measured_count
        group = _measure_group(mutables, names, scene, frames)
        measured_count += 1
        yield Progress("bones", measured_count, MAX_MEASUREMENTS)
        return group

    queue = [(yield from measure(mutables))]
    groups: list[BoneGroup] = []
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


def mutables_by_bone(armature_object: bpy.types.Object) -> dict[str, list[Mutable]]:
    """Return the enabled constraints and drivers of an armature by the name of the bone, in the order of the bones."""
    mutables: dict[str, list[Mutable]] = {bone.name: [] for bone in armature_object.pose.bones}
    for bone in armature_object.pose.bones:
        mutables[bone.name] += [constraint for constraint in bone.constraints if not constraint.mute]
    for datablock in (armature_object, armature_object.data):
        animation = datablock.animation_data
        for curve in animation.drivers if animation else ():
            if not curve.mute:
                bone_name, _ = split_bone_path(curve.data_path)
                mutables.setdefault(bone_name if bone_name in mutables else NO_BONE, []).append(curve)
    return {name: bone_mutables for name, bone_mutables in mutables.items() if bone_mutables}


def _measure_group(
    mutables: dict[str, list[Mutable]], names: Iterable[str], scene: bpy.types.Scene, frames: range
) -> BoneGroup:
    group = [mutable for name in names for mutable in mutables[name]]
    rounds, ratios = [], []
    for round_index in range(ROUNDS):
        first_index = round_index * FRAMES_PER_ROUND
        rounds.append(scene_times(scene, frames, first_index, FRAMES_PER_ROUND))
        with _muted(group):
            ratios.append(1 - scene_times(scene, frames, first_index, FRAMES_PER_ROUND) / rounds[-1])
    full_ms = statistics.median(rounds)
    driver_count = sum(isinstance(mutable, bpy.types.FCurve) for mutable in group)
    return BoneGroup(
        tuple(names), len(group) - driver_count, driver_count, Duration.of([ratio * full_ms for ratio in ratios])
    )


@contextmanager
def _muted(mutables: list[Mutable]) -> Iterator[None]:
    """Mute constraints and drivers in the block, and unmute them afterwards."""
    try:
        for mutable in mutables:
            mutable.mute = True
        yield
    finally:
        for mutable in mutables:
            mutable.mute = False
