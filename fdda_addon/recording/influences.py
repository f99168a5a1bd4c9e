# SPDX-License-Identifier: GPL-3.0-or-later
"""Detection of the joints and controls that influence each partition, by moving one at a time (paper, section 3.3).

Joints with sampled channels are moved by these channels. In a control rig, control bones move many joints at once
through constraints. There each joint is set alone to its transform in other poses, with all constraints muted.
Controls are moved alone in both cases.
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
from ..rig.sources import split_bone_path
from ..scene.armature import Poser, clear_pose
from ..scene.controls import ControlReader, is_driven, owner_of, set_control
from ..scene.scene_rig import SceneRig
from .joint_override import JointOverride, override_joints

MIN_TRANSFORM_CHANGE = 1e-5
"""Smallest change of a joint's relative transform between poses that counts as motion (no unit, or meters)."""
MAX_BATCH_MOVES, BATCH_BYTES = 50, 6 << 20
"""Limits of a batch of moves whose residuals are computed together."""


@dataclass(frozen=True)
class InfluenceSearch:
    """Settings of the detection of influences.

    Attributes:
        channels: of the random poses; may be empty.
        draw_values: returns random values of the channels, (C,), for an index from 0.
        show_pose: sets a recorded pose for an index from 0; used without channels.
        stop_playback: ends the playback of `show_pose`.
        has_target: the surface is that of another object, which other bones than the joints may deform.
        poses: how many times each joint is moved alone.
        tolerance: a joint influences a partition when it changes a local residual by more than this ratio of the
            rig's size.
    """

    channels: tuple[Channel, ...]
    draw_values: Callable[[int], np.ndarray]
    show_pose: Callable[[int], None]
    stop_playback: Callable[[], None]
    poses: int = INFLUENCE_POSES
    tolerance: float = INFLUENCE_TOLERANCE
    has_target: bool = False


class _InfluenceCollector:
    """Collects the influences on partitions."""

    def __init__(self, rig: Rig, tolerance: float, partitions: tuple[Partition, ...]):
        # Far from the origin, rounding moves vertices.
        self._threshold = max(
            tolerance * rig.size, 2 * FLOAT32_ROUNDING_RATIO * float(np.abs(rig.rest_positions).max())
        )
        self.partitions = partitions
        self._joints: dict[int, set[int]] = {p.joint: set() for p in partitions}
        self._controls: dict[int, set[int]] = {p.joint: set() for p in partitions}

    def add(self, moves: list[tuple[str, int]], moved: np.ndarray, base: np.ndarray) -> None:
        """Compare (n, V, 3) residuals of n moves with the (1, V, 3) residuals of the base pose."""
        changes = max_residual_changes(self.partitions, moved, base)
        for (kind, index), influenced in zip(moves, changes > self._threshold, strict=True):
            influences = self._controls if kind == CONTROL else self._joints
            for partition_index in np.flatnonzero(influenced):
                influences[self.partitions[partition_index].joint].add(index)

    def add_to_all(self, control: int) -> None:
        """Add a control to all partitions."""
        for influences in self._controls.values():
            influences.add(control)

    def result(self, rig: Rig) -> tuple[Partition, ...]:
        joints, controls = (
            {joint: tuple(sorted(influences)) for joint, influences in by_joint.items()}
            for by_joint in (self._joints, self._controls)
        )
        merged = {joint: partition.joint for partition in self.partitions for joint in partition.merged}
        return make_partitions(rig, joints, controls, merged)


class _MoveBatch:
    """Batch of moves from a base pose, whose residuals are computed together, which is faster than one by one."""

    def __init__(
        self, rig: Rig, partitions: tuple[Partition, ...], evaluator: PoseEvaluator, collector: _InfluenceCollector
    ):
        self._skinning, self._evaluator, self._collector = LinearSkinning(rig, partitions), evaluator, collector
        self._batch_size = max(1, min(MAX_BATCH_MOVES, BATCH_BYTES // (12 * rig.vertex_count)))
        self._base: np.ndarray | None = None
        self._moves: list[tuple[str, int]] = []
        self._evaluated: list[tuple[np.ndarray, np.ndarray]] = []

    def set_base(self) -> None:
        """Use the current pose as base pose."""
        self._base = self._residuals([self._evaluator.evaluate()[:2]])

    def add(self, kind: str, index: int) -> None:
        """Evaluate the current pose, the base pose with one joint or control moved."""
        self._moves.append((kind, index))
        self._evaluated.append(self._evaluator.evaluate()[:2])
        if len(self._moves) == self._batch_size:
            self.flush()

    def flush(self) -> None:
        """Compare the remaining moves with the base pose."""
        if self._moves:
            self._collector.add(self._moves, self._residuals(self._evaluated), self._base)
        self._moves, self._evaluated = [], []

    def _residuals(self, evaluated: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        return self._skinning.local_residuals(*(np.stack(arrays) for arrays in zip(*evaluated, strict=True)))


def detect_influences(
    scene_rig: SceneRig, rig: Rig, partitions: tuple[Partition, ...], evaluator: PoseEvaluator, search: InfluenceSearch
) -> Iterator[Progress]:
    """Detect the influences on the partitions of a rig while the generator is iterated.

    The caller restores the pose of the armature and the values of sampled controls.

    Yields:
        Progress of the stage "influences".

    Returns:
        The partitions with their influencing joints and controls.
    """
    collector = _InfluenceCollector(rig, search.tolerance, partitions)
    moves = _MoveBatch(rig, partitions, evaluator, collector)
    if _follows_control_bones(scene_rig, rig, search.channels):
        yield from _override_each_joint(scene_rig, rig, search, collector, moves)
    else:
        yield from _move_channels(scene_rig, rig, search, moves)
    clear_pose(scene_rig.armature_object)
    return collector.result(rig)


def _follows_control_bones(scene_rig: SceneRig, rig: Rig, channels: tuple[Channel, ...]) -> bool:
    """Return whether joints move by other means than their own channels."""
    sampled = {channel.name for channel in channels}
    bones = scene_rig.armature_object.pose.bones
    animation = scene_rig.armature_object.animation_data
    paths = [curve.data_path for curve in (animation.drivers if animation else ())]
    driven = {bone for bone, _ in map(split_bone_path, paths) if bone}
    others = [name for name in rig.joint_names if name not in sampled and name != STATIC_JOINT]
    if any(name not in rig.joint_names for name in sampled if name in bones):
        return True
    return not sampled or any(is_moved_by_constraints(bones[name]) or name in driven for name in others)


def _move_channels(scene_rig: SceneRig, rig: Rig, search: InfluenceSearch, moves: _MoveBatch) -> Iterator[Progress]:
    """Move the channels of one joint or control at a time, from the rest pose and from random poses."""
    channels, count = search.channels, search.poses
    poser = Poser(scene_rig, channels)
    joints = {name: index for index, name in enumerate(rig.joint_names)}
    controls = {control.name: index for index, control in enumerate(rig.controls)}
    channel_indices: dict[tuple[str, int], list[int]] = {}
    for channel_index, channel in enumerate(channels):
        index = (controls if channel.kind == CONTROL else joints).get(channel.name)
        if index is not None:
            channel_indices.setdefault((CONTROL if channel.kind == CONTROL else "joint", index), []).append(
                channel_index
            )
        # A control may be the property that a channel of a bone sets.
        if (control := controls.get(control_name(scene_rig.armature_object, channel))) is not None:
            channel_indices[CONTROL, control] = [channel_index]
    moved_inputs = dict(sorted(channel_indices.items(), key=lambda item: (item[0][0] == CONTROL, item[0][1])))
    rest = np.array([channel.rest for channel in channels])
    # All joints share the base poses: the rest pose for half of the moves, random poses for the others.
    bases = [rest] * (count - count // 2) + [search.draw_values(index) for index in range(count // 2)]
    total = count * (len(moved_inputs) + 1)
    for base_index, base in enumerate(bases):
        poser.set(base)
        moves.set_base()
        for step, ((kind, index), moved_channels) in enumerate(
            moved_inputs.items(), base_index * (len(moved_inputs) + 1) + 1
        ):
            yield Progress("influences", step, total)
            values = base.copy()
            offset = index if kind != CONTROL else len(joints) + index
            values[moved_channels] = search.draw_values((offset + 1) * count + base_index)[moved_channels]
            poser.set(values)
            moves.add(kind, index)
        moves.flush()
        yield Progress("influences", (base_index + 1) * (len(moved_inputs) + 1), total)


def _override_each_joint(
    scene_rig: SceneRig, rig: Rig, search: InfluenceSearch, collector: _InfluenceCollector, moves: _MoveBatch
) -> Iterator[Progress]:
    """Set one joint or control at a time to its state in other poses, and keep the others."""
    count = search.poses
    states = _sample_states(scene_rig, rig, search, 2 * count)
    clear_pose(scene_rig.armature_object)
    stacked = np.stack([state.joints for state in states])
    changes = np.abs(stacked - stacked[0])
    changes[..., :3, 3] *= rig.metres_per_unit
    moving_joints = np.flatnonzero(changes.max(axis=(0, 2, 3)) > MIN_TRANSFORM_CHANGE).tolist()
    movable = [n for n, c in enumerate(rig.controls) if not is_driven(owner_of(scene_rig, c.owner), c.path)]
    for control in set(range(len(rig.controls))) - set(movable):
        # A driven property cannot be moved alone, so it may influence all partitions.
        collector.add_to_all(control)
    moved_inputs = [("joint", index) for index in moving_joints] + [(CONTROL, index) for index in movable]
    with override_joints(scene_rig, rig.joints, search.has_target) as override:

        def show_pose(state: _PoseState) -> None:
            override.set(state.joints)
            for index in movable:
                set_control(scene_rig, rig.controls[index].name, float(state.controls[index]))

        rest_state = _PoseState(override.rest, states[0].controls)
        bases = [rest_state] * (count - count // 2) + states[: count // 2]
        for base_index, (base, other) in enumerate(zip(bases, states[count:], strict=True)):
            show_pose(base)
            moves.set_base()
            for step, (kind, index) in enumerate(moved_inputs, base_index * (len(moved_inputs) + 1) + 1):
                yield Progress("influences", step, count * (len(moved_inputs) + 1))
                show_pose(base.with_one_of(other, kind, index))
                moves.add(kind, index)
            moves.flush()
            yield Progress("influences", (base_index + 1) * (len(moved_inputs) + 1), count * (len(moved_inputs) + 1))


@dataclass(frozen=True)
class _PoseState:
    """State of a pose: (J, 4, 4) matrices of joints relative to their parents, and (C,) values of controls."""

    joints: np.ndarray
    controls: np.ndarray

    def with_one_of(self, other: "_PoseState", kind: str, index: int) -> "_PoseState":
        """Return a copy with one joint or control of another state."""
        joints, controls = self.joints.copy(), self.controls.copy()
        if kind == CONTROL:
            controls[index] = other.controls[index]
        else:
            joints[index] = other.joints[index]
        return _PoseState(joints, controls)


def _sample_states(scene_rig: SceneRig, rig: Rig, search: InfluenceSearch, count: int) -> list[_PoseState]:
    """Read the states of joints and controls in poses of the recording."""
    poser = Poser(scene_rig, search.channels)
    override = JointOverride(scene_rig, rig.joints)
    reader = ControlReader(scene_rig, rig.controls)
    states = []
    for index in range(count):
        if search.channels:
            poser.set(search.draw_values(index))
        else:
            search.show_pose(index)
        states.append(_PoseState(override.read(), reader.read(scene_rig, bpy.context.evaluated_depsgraph_get())))
    search.stop_playback()
    return states
