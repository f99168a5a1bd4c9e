# SPDX-License-Identifier: GPL-3.0-or-later
"""Evaluates bones and shown objects in the same random poses and actions before and after bones are removed."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import bpy
import numpy as np
from mathutils import Euler

from ..core.progress import Job, Progress
from ..poses.action_range import action_frames
from ..scene.action_slots import ActionSlots, constraint_actions, dependencies, slots_of_action
from ..scene.animated_values import animated_values, set_value
from ..scene.armature import PoseMatrixReader, clear_pose, rotate_bone
from ..scene.temporary_state import animation_state, assign_action, restore_animation, temporary_pose
from ..scene.time_stretching import unstretched_time
from .controls import animating_actions
from .object_values import DrivenProperty, ObjectReader, objects_evaluated

RANDOM_POSE_COUNT = 200
MAX_ACTION_FRAMES = 40
"""Largest number of frames of one action that are evaluated, evenly over its length."""
ROTATION_DEGREES, LOCATION_RATIO, SCALE_RATIO = 25.0, 0.03, 0.05
"""Standard deviations of random poses: about each axis, of the size of the rig along each axis, and of the scale."""
RIG_SEED = 1 << 32
"""Seed of the custom properties of the armature object; those of bones have the indices of the bones."""
MAX_PROPERTY_WIDTH = 1000.0
"""Custom properties with a wider range keep their value."""


@dataclass(frozen=True)
class ComparedPoses:
    """What `evaluate_poses` evaluates.

    Attributes:
        armature_object: the armature object.
        bone_names: names of the B bones to read.
        control_names: names of the bones that random poses move.
        actions: the actions to play.
        size: size of the rig, armature units.
        objects, driven: the objects and driven properties to read.
        pose_count: number of random poses.
    """

    armature_object: bpy.types.Object
    bone_names: tuple[str, ...]
    control_names: tuple[str, ...]
    actions: tuple[bpy.types.Action, ...]
    size: float
    objects: tuple[bpy.types.Object, ...] = ()
    driven: tuple[DrivenProperty, ...] = ()
    pose_count: int = RANDOM_POSE_COUNT


class Evaluation(NamedTuple):
    """What was read in P poses.

    Attributes:
        matrices: (P, B, 4, 4) float32 pose matrices of the bones, armature space, armature units.
        objects: as `ObjectReader.values`.
    """

    matrices: np.ndarray
    objects: dict[str, list[np.ndarray]]


def evaluate_poses(poses: ComparedPoses, stage: str) -> Job[Evaluation]:
    """Evaluate bones and objects in all poses while the generator is iterated, and restore the rig.

    Args:
        stage: stage of the progress.
    """
    armature_object, shown_poses = poses.armature_object, list(_pose_setters(poses))
    bone_reader = PoseMatrixReader(armature_object, poses.bone_names)
    world_size = poses.size * max(armature_object.matrix_world.to_scale(), key=abs)
    object_reader = ObjectReader(poses.objects, poses.driven, abs(world_size), len(shown_poses))
    matrices = np.empty((len(shown_poses), len(poses.bone_names), 4, 4), np.float32)
    with (
        temporary_pose(armature_object, poses.actions),
        unstretched_time(),
        _restored_values(poses),
        objects_evaluated({armature_object, *poses.objects}),
    ):
        # Some drivers read the pose before. So the first pose follows itself in each evaluation.
        shown_poses[0]()
        for index, show_pose in enumerate(shown_poses):
            show_pose()
            depsgraph = bpy.context.evaluated_depsgraph_get()
            matrices[index] = bone_reader.read(armature_object.evaluated_get(depsgraph))
            object_reader.read(depsgraph)
            yield Progress(stage, index + 1, len(shown_poses))
    return Evaluation(matrices, object_reader.values)


def differing_bones(poses: ComparedPoses, before: np.ndarray, after: np.ndarray, tolerance: float) -> dict[str, float]:
    """Compare the matrices of two evaluations.

    Args:
        before, after: (P, B, 4, 4), as in `Evaluation`.
        tolerance: largest accepted difference, as a ratio of the size of the rig for translations, and absolute for
            rotations and scales.

    Returns:
        The largest difference of each bone that differs, by name, in the unit of `tolerance`. It is infinite where
        only one of the evaluations is finite. Elements that neither has finite count as equal.
    """
    with np.errstate(invalid="ignore"):
        differences = np.abs(before.astype(np.float64) - after)
    differences[..., :3, 3] /= poses.size
    # Some rigs give NaN in extreme poses; the other evaluation must do so too.
    differences[~np.isfinite(differences)] = np.inf
    differences[~np.isfinite(before) & ~np.isfinite(after)] = 0.0
    largest = differences.max(axis=(0, 2, 3), initial=0)
    return {name: float(value) for name, value in zip(poses.bone_names, largest, strict=True) if value > tolerance}


def infinite_bones(poses: ComparedPoses, matrices: np.ndarray) -> dict[str, int]:
    """Count, by name of the bone, the poses in which an element of its (P, B, 4, 4) matrices is not finite."""
    counts = (~np.isfinite(matrices)).any(axis=(2, 3)).sum(axis=0)
    return {name: int(count) for name, count in zip(poses.bone_names, counts, strict=True) if count}


def rig_size(armature_object: bpy.types.Object) -> float:
    """Return the diagonal of the bounding box of the bones at rest, armature units."""
    ends = np.array([[*bone.head_local, *bone.tail_local] for bone in armature_object.data.bones]).reshape(-1, 3)
    return float(np.linalg.norm(np.ptp(ends, axis=0)))


def set_random_pose(armature_object: bpy.types.Object, names: Iterable[str], size: float, seed: int) -> None:
    """Set the channels and custom properties of some bones at random, except locked channels; others do not change.

    Args:
        names: names of the bones. The values of a bone depend only on the seed and on its index in `names`.
        size: size of the rig, armature units.
        seed: seed of the pose.
    """
    for index, name in enumerate(names):
        bone = armature_object.pose.bones[name]
        generator = np.random.default_rng((seed, index))
        angles = np.radians(ROTATION_DEGREES) * generator.normal(size=3)
        rotate_bone(bone, Euler(np.where(bone.lock_rotation, 0.0, angles)).to_quaternion())
        offsets = LOCATION_RATIO * size * generator.normal(size=3)
        bone.location = np.where(bone.lock_location, 0.0, offsets)
        bone.scale = np.where(bone.lock_scale, 1.0, 1.0 + SCALE_RATIO * generator.normal(size=3))
        _set_properties(bone, generator)
    _set_properties(armature_object, np.random.default_rng((seed, RIG_SEED)))
    armature_object.update_tag(refresh={"OBJECT", "DATA"})


def playable_actions(armature_object: bpy.types.Object) -> tuple[bpy.types.Action, ...]:
    """Return the actions of the file that animate an armature object or other datablocks, assigned now or not."""
    animating = animating_actions(armature_object)
    excluded = {*animating, *constraint_actions(armature_object)}
    others = [action for action in bpy.data.actions if action not in excluded]
    return (*animating, *(action for action in others if _animated_slots(armature_object, action)))


def _pose_setters(poses: ComparedPoses) -> Iterator[Callable[[], None]]:
    """Yield functions that show the random poses, and then the frames of the actions."""
    armature_object = poses.armature_object

    def show_random(seed: int) -> None:
        set_random_pose(armature_object, poses.control_names, poses.size, seed)
        bpy.context.view_layer.update()

    properties = _property_values(poses)

    def show_first_frame(action: bpy.types.Action, frame: int) -> None:
        clear_pose(armature_object)
        _restore_properties(properties)
        # Otherwise, the evaluated rig may keep unkeyed bones in the pose before.
        armature_object.update_tag(refresh={"OBJECT", "DATA"})
        # An action of removed bones alone has no slot any more.
        assign_action(armature_object, None, None)
        for datablock, slot in _animated_slots(armature_object, action).items():
            assign_action(datablock, action, slot)
        bpy.context.scene.frame_set(frame)

    for seed in range(poses.pose_count):
        yield lambda seed=seed: show_random(seed)
    for action in poses.actions:
        frames = list(action_frames(action))
        indices = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MAX_ACTION_FRAMES)).round().astype(int))
        yield lambda action=action, frame=frames[0]: show_first_frame(action, frame)
        yield from (lambda frame=frames[index]: bpy.context.scene.frame_set(frame) for index in indices[1:])


def _animated_slots(armature_object: bpy.types.Object, action: bpy.types.Action) -> ActionSlots:
    """Return the slots with which an action animates the rig, and other datablocks whose names its slots have."""
    named = {(slot.target_id_type, slot.name_display): slot for slot in action.slots}
    datablocks = {(d.id_type, d.name): d for d in bpy.data.user_map() if d.library is None}
    slots = {datablocks[key]: slot for key, slot in named.items() if key in datablocks}
    return slots | slots_of_action(action, dependencies(armature_object))


@contextmanager
def _restored_values(poses: ComparedPoses) -> Iterator[None]:
    """Restore the custom properties that random poses set, and the actions and values of other animated datablocks."""
    properties = _property_values(poses)
    animated = {d for action in poses.actions for d in _animated_slots(poses.armature_object, action)}
    before = [(d, animation_state(d), animated_values(d, poses.actions)) for d in animated - {poses.armature_object}]
    try:
        yield
    finally:
        for datablock, state, values in before:
            restore_animation(datablock, state)
            for path, value in values.items():
                set_value(datablock, path, value)
        _restore_properties(properties)
        poses.armature_object.update_tag(refresh={"OBJECT", "DATA"})
        bpy.context.view_layer.update()


def _set_properties(owner: bpy.types.PoseBone | bpy.types.Object, generator: np.random.Generator) -> None:
    for key, low, high in _ranged_properties(owner):
        value = generator.uniform(low, high)
        owner[key] = type(owner[key])(round(value)) if isinstance(owner[key], bool | int) else value


def _ranged_properties(owner: bpy.types.PoseBone | bpy.types.Object) -> Iterator[tuple[str, float, float]]:
    """Yield the custom properties of a bone or an object that are numbers with a range: key, lowest, highest value."""
    for key in sorted(owner.keys()):
        value = owner[key]
        if isinstance(value, bool):
            yield key, 0, 1
        elif isinstance(value, int | float):
            settings = owner.id_properties_ui(key).as_dict()
            low, high = settings["soft_min"], settings["soft_max"]
            if 0 < high - low <= MAX_PROPERTY_WIDTH:
                yield key, low, high


def _property_values(poses: ComparedPoses) -> list[tuple[bpy.types.bpy_struct, str, object]]:
    """Return the custom properties that random poses set: owner, key and value."""
    owners = [poses.armature_object, *(poses.armature_object.pose.bones[name] for name in poses.control_names)]
    return [(owner, key, owner[key]) for owner in owners for key, _, _ in _ranged_properties(owner)]


def _restore_properties(values: list[tuple[bpy.types.bpy_struct, str, object]]) -> None:
    for owner, key, value in values:
        owner[key] = value
