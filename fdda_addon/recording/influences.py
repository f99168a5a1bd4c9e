# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds which joints and controls each partition depends on, by moving one at a time (paper, section 3.3).

Joints that random poses move are moved as random poses move them. In a control rig the joints follow from control
bones through constraints, many at a time: there each joint is taken by itself to where it was seen in other poses, with
all constraints muted. Controls are moved alone in both ways.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import bpy
import numpy as np

from ..core.defaults import INFLUENCE_POSES
from ..core.features import FLOAT32_ROUNDING_RATIO
from ..core.partition import INFLUENCE_TOLERANCE, Partition, make_partitions, max_residual_changes
from ..core.poses import CONTROL, Channel
from ..core.progress import Progress
from ..core.rig import STATIC_JOINT, Rig
from ..core.skinning import LinearSkinning
from ..poses.bone_channels import control_name
from ..poses.sampling import is_moved_by_constraints
from ..rig.reading import PoseEvaluator
from ..scene.armature import Poser, clear_pose
from ..scene.controls import ControlReader, is_driven, owner_of, set_control
from ..scene.scene_rig import SceneRig
from .held_pose import HeldPose, held_joints

VARIES = 1e-5
"""A joint whose relative transform changes by less between poses does not move (no unit, or metres)."""
MAX_MOVES, BATCH_BYTES = 50, 6 << 20
"""Residuals of moves are computed together: at most this number, and at most this many bytes."""


@dataclass(frozen=True)
class Search:
    """What to search influences with.

    Attributes:
        channels: of the random poses; may be empty.
        draw: gives the values of the channels, (C,), for a number from 0 on.
        show: poses the rig as one of the recorded poses, for a number from 0 on, when there are no channels.
        stop: ends what `show` lets drive the rig.
        has_target: the surface is that of another object, which other bones may deform than the joints.
        poses: how often each joint is moved alone.
        tolerance: a joint influences a partition when it moves a local residual by more than this part of the
            character's size.
    """

    channels: tuple[Channel, ...]
    draw: Callable[[int], np.ndarray]
    show: Callable[[int], None]
    stop: Callable[[], None]
    poses: int = INFLUENCE_POSES
    tolerance: float = INFLUENCE_TOLERANCE
    has_target: bool = False


class _Found:
    """Influences as they are found."""

    def __init__(self, rig: Rig, tolerance: float, partitions: tuple[Partition, ...]):
        # Far from the origin, rounding alone moves vertices.
        self._threshold = max(
            tolerance * rig.size, 2 * FLOAT32_ROUNDING_RATIO * float(np.abs(rig.rest_positions).max())
        )
        self.partitions = partitions
        self._joints: dict[int, set[int]] = {p.joint: set() for p in partitions}
        self._controls: dict[int, set[int]] = {p.joint: set() for p in partitions}

    def note(self, moves: list[tuple[str, int]], moved: np.ndarray, base: np.ndarray) -> None:
        """Compare residuals with and without a joint or control moved: (n, V, 3) of n moves, (1, V, 3) without."""
        changes = max_residual_changes(self.partitions, moved, base)
        for (kind, index), influenced in zip(moves, changes > self._threshold, strict=True):
            into = self._controls if kind == CONTROL else self._joints
            for number in np.flatnonzero(influenced):
                into[self.partitions[number].joint].add(index)

    def note_everywhere(self, control: int) -> None:
        """A control that may influence every partition."""
        for found in self._controls.values():
            found.add(control)

    def result(self, rig: Rig) -> tuple[Partition, ...]:
        joints, controls = (
            {joint: tuple(sorted(found)) for joint, found in sets.items()} for sets in (self._joints, self._controls)
        )
        merged = {joint: partition.joint for partition in self.partitions for joint in partition.merged}
        return make_partitions(rig, joints, controls, merged)


class _Moves:
    """Moves from a base pose. Residuals of many are computed at once: each partition costs as much for one pose."""

    def __init__(self, rig: Rig, partitions: tuple[Partition, ...], evaluator: PoseEvaluator, found: _Found):
        self._layer, self._evaluator, self._found = LinearSkinning(rig, partitions), evaluator, found
        self._size = max(1, min(MAX_MOVES, BATCH_BYTES // (12 * rig.vertex_count)))
        self._base: np.ndarray | None = None
        self._moves: list[tuple[str, int]] = []
        self._evaluated: list[tuple[np.ndarray, np.ndarray]] = []

    def begin(self) -> None:
        """The pose that is set now is the base of those that follow."""
        self._base = self._residuals([self._evaluator.evaluate()[:2]])

    def add(self, kind: str, index: int) -> None:
        """The pose that is set now is the base with a joint or control moved."""
        self._moves.append((kind, index))
        self._evaluated.append(self._evaluator.evaluate()[:2])
        if len(self._moves) == self._size:
            self.end()

    def end(self) -> None:
        """No move from this base follows."""
        if self._moves:
            self._found.note(self._moves, self._residuals(self._evaluated), self._base)
        self._moves, self._evaluated = [], []

    def _residuals(self, evaluated: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        return self._layer.local_residuals(*(np.stack(arrays) for arrays in zip(*evaluated, strict=True)))


def find_influences(
    scene_rig: SceneRig, rig: Rig, partitions: tuple[Partition, ...], evaluator: PoseEvaluator, search: Search
) -> Iterator[Progress]:
    """Find the influences on the partitions of a rig; a generator that does the work while it is iterated.

    The pose of the armature and the values of the controls that are sampled are borrowed by the caller.

    Yields:
        Progress of the stage "influences".

    Returns:
        The partitions with what influences them.
    """
    found = _Found(rig, search.tolerance, partitions)
    moves = _Moves(rig, partitions, evaluator, found)
    if _follows_control_bones(scene_rig, rig, search.channels):
        yield from _take_joints(scene_rig, rig, search, found, moves)
    else:
        yield from _move_channels(scene_rig, rig, search, moves)
    clear_pose(scene_rig.armature_object)
    return found.result(rig)


def _follows_control_bones(scene_rig: SceneRig, rig: Rig, channels: tuple[Channel, ...]) -> bool:
    """Whether joints move otherwise than by channels of their own."""
    sampled = {channel.name for channel in channels}
    bones = scene_rig.armature_object.pose.bones
    animation = scene_rig.armature_object.animation_data
    paths = [curve.data_path for curve in (animation.drivers if animation else ())]
    driven = {path.split('"')[1] for path in paths if '"' in path}
    others = [name for name in rig.joint_names if name not in sampled and name != STATIC_JOINT]
    if any(name not in rig.joint_names for name in sampled if name in bones):
        return True
    return not sampled or any(is_moved_by_constraints(bones[name]) or name in driven for name in others)


def _move_channels(scene_rig: SceneRig, rig: Rig, search: Search, moves: _Moves) -> Iterator[Progress]:
    """Move the channels of one joint, or one control, at a time, from the rest pose and from random ones."""
    channels, count = search.channels, search.poses
    poser = Poser(scene_rig, channels)
    joints = {name: number for number, name in enumerate(rig.joint_names)}
    controls = {control.name: number for number, control in enumerate(rig.controls)}
    places: dict[tuple[str, int], list[int]] = {}
    for place, channel in enumerate(channels):
        index = (controls if channel.kind == CONTROL else joints).get(channel.name)
        if index is not None:
            places.setdefault((CONTROL if channel.kind == CONTROL else "joint", index), []).append(place)
        # A control may be the number that a channel of a bone sets.
        if (control := controls.get(control_name(scene_rig.armature_object, channel))) is not None:
            places[CONTROL, control] = [place]
    steps = dict(sorted(places.items(), key=lambda item: (item[0][0] == CONTROL, item[0][1])))
    rest = np.array([channel.rest for channel in channels])
    # One base pose serves all joints: the rest pose for half of the moves, a random pose each for the others.
    bases = [rest] * (count - count // 2) + [search.draw(number) for number in range(count // 2)]
    total = count * (len(steps) + 1)
    for number, base in enumerate(bases):
        poser.set(base)
        moves.begin()
        for step, ((kind, index), own) in enumerate(steps.items(), number * (len(steps) + 1) + 1):
            yield Progress("influences", step, total)
            values = base.copy()
            offset = index if kind != CONTROL else len(joints) + index
            values[own] = search.draw((offset + 1) * count + number)[own]
            poser.set(values)
            moves.add(kind, index)
        moves.end()
        yield Progress("influences", (number + 1) * (len(steps) + 1), total)


def _take_joints(scene_rig: SceneRig, rig: Rig, search: Search, found: _Found, moves: _Moves) -> Iterator[Progress]:
    """Take one joint, or one control, at a time to where it is in other poses, the others held."""
    count = search.poses
    seen = _seen_states(scene_rig, rig, search, 2 * count)
    clear_pose(scene_rig.armature_object)
    stacked = np.stack([state.joints for state in seen])
    apart = np.abs(stacked - stacked[0])
    apart[..., :3, 3] *= rig.metres_per_unit
    varies = np.flatnonzero(apart.max(axis=(0, 2, 3)) > VARIES).tolist()
    movable = [n for n, c in enumerate(rig.controls) if not is_driven(owner_of(scene_rig, c.owner), c.path)]
    for control in set(range(len(rig.controls))) - set(movable):
        # A number that a driver sets cannot be moved alone: it may influence all.
        found.note_everywhere(control)
    steps = [("joint", number) for number in varies] + [(CONTROL, number) for number in movable]
    with held_joints(scene_rig, rig.joints, search.has_target) as held:

        def show(state: _State) -> None:
            held.set(state.joints)
            for number in movable:
                set_control(scene_rig, rig.controls[number].name, float(state.controls[number]))

        resting = _State(held.rest, seen[0].controls)
        bases = [resting] * (count - count // 2) + seen[: count // 2]
        for number, (base, other) in enumerate(zip(bases, seen[count:], strict=True)):
            show(base)
            moves.begin()
            for step, (kind, index) in enumerate(steps, number * (len(steps) + 1) + 1):
                yield Progress("influences", step, count * (len(steps) + 1))
                show(base.with_one_of(other, kind, index))
                moves.add(kind, index)
            moves.end()
            yield Progress("influences", (number + 1) * (len(steps) + 1), count * (len(steps) + 1))


@dataclass(frozen=True)
class _State:
    """(J, 4, 4) joints relative to their parents, the unmoved joint left out, and (C,) controls."""

    joints: np.ndarray
    controls: np.ndarray

    def with_one_of(self, other: "_State", kind: str, index: int) -> "_State":
        """This state with one joint or control of another."""
        joints, controls = self.joints.copy(), self.controls.copy()
        if kind == CONTROL:
            controls[index] = other.controls[index]
        else:
            joints[index] = other.joints[index]
        return _State(joints, controls)


def _seen_states(scene_rig: SceneRig, rig: Rig, search: Search, count: int) -> list[_State]:
    """What poses of the recording bring joints and controls to."""
    poser = Poser(scene_rig, search.channels)
    held = HeldPose(scene_rig, rig.joints)
    reader = ControlReader(scene_rig, rig.controls)
    states = []
    for number in range(count):
        if search.channels:
            poser.set(search.draw(number))
        else:
            search.show(number)
        states.append(_State(held.read(), reader.read(scene_rig, bpy.context.evaluated_depsgraph_get())))
    search.stop()
    return states
