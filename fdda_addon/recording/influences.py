# SPDX-License-Identifier: GPL-3.0-or-later
"""Detects the joints and controls that influence each partition, by moving one at a time (paper, section 3.3).

Joints with sampled channels are moved by these channels. In a control rig, control bones move many joints at once
through constraints. So in a control rig, each joint alone is set to its transform in other poses, with all constraints
muted. Controls are moved one at a time in both cases.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix

from ..core.defaults import INFLUENCE_POSES
from ..core.features import FLOAT32_ROUNDING_RATIO
from ..core.partition import INFLUENCE_TOLERANCE, Partition, make_partitions, max_residual_changes
from ..core.poses import CONTROL, Channel
from ..core.progress import Progress
from ..core.rig import STATIC_JOINT, Rig
from ..core.skinning import LinearSkinning
from ..poses.bone_channels import is_moved_by_constraints
from ..rig.reading import PoseEvaluator
from ..rig.sources import split_bone_path
from ..scene.armature import Poser, clear_pose
from ..scene.bone_transform import controls_by_bone
from ..scene.control_reader import ControlReader
from ..scene.controls import is_driven, owner_of, set_control
from ..scene.scene_rig import SceneRig
from .joint_override import JointOverride, override_joints

MIN_TRANSFORM_CHANGE = 1e-5
"""Smallest change of a joint's relative transform between poses that counts as motion (no unit, or meters)."""
MAX_BATCH_MOVES, BATCH_BYTES = 50, 6 << 20
"""Limits of a batch whose residuals are computed together: moves of single joints, and bytes of their positions."""


@dataclass(frozen=True)
class InfluenceSearch:
    """Settings of the detection of influences.

    Attributes:
        channels: channels of the random poses; may be empty.
        draw_values: returns random values of the channels, (C,), for an index from 0.
        show_pose: sets a recorded pose for an index from 0; used without channels.
        stop_playback: ends the playback of `show_pose`.
        has_target: the surface is that of a target, which bones other than the joints may deform.
        poses: number of times that each joint is moved alone.
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
    """Collects the influences of joints and controls on partitions."""

    def __init__(self, rig: Rig, tolerance: float, partitions: tuple[Partition, ...]):
        # Far from the origin, rounding moves vertices, so the threshold must be larger.
        self._threshold = max(
            tolerance * rig.size, 2 * FLOAT32_ROUNDING_RATIO * float(np.abs(rig.rest_positions).max())
        )
        self.partitions = partitions
        self._influencing_joints: dict[int, set[int]] = {p.joint: set() for p in partitions}
        self._influencing_controls: dict[int, set[int]] = {p.joint: set() for p in partitions}
        self._controls_of_bone = {indices[0]: indices for indices in controls_by_bone(rig.controls).values()}

    def add(self, moves: list[tuple[str, int]], moved_residuals: np.ndarray, base_residuals: np.ndarray) -> None:
        """Compare (n, V, 3) residuals of n moves with the (1, V, 3) residuals of the base pose.

        The first control of a bone stands for all controls of its transform.
        """
        changes = max_residual_changes(self.partitions, moved_residuals, base_residuals)
        for (kind, index), is_influenced in zip(moves, changes > self._threshold, strict=True):
            influences = self._influencing_controls if kind == CONTROL else self._influencing_joints
            for partition_index in np.flatnonzero(is_influenced):
                indices = self._controls_of_bone.get(index, (index,)) if kind == CONTROL else (index,)
                influences[self.partitions[partition_index].joint].update(indices)

    def add_to_all(self, control: int) -> None:
        """Add a control to all partitions."""
        for influences in self._influencing_controls.values():
            influences.add(control)

    def make_partitions(self, rig: Rig) -> tuple[Partition, ...]:
        """Make the partitions with the collected influences."""
        joints, controls = (
            {joint: tuple(sorted(influences)) for joint, influences in influences_by_joint.items()}
            for influences_by_joint in (self._influencing_joints, self._influencing_controls)
        )
        main_joints_of_merged = {joint: partition.joint for partition in self.partitions for joint in partition.merged}
        return make_partitions(rig, joints, controls, main_joints_of_merged)


class _MoveBatch:
    """Batch of moves from a base pose. Computing their residuals together is faster than one by one."""

    def __init__(
        self, rig: Rig, partitions: tuple[Partition, ...], evaluator: PoseEvaluator, collector: _InfluenceCollector
    ):
        self._skinning, self._evaluator, self._collector = LinearSkinning(rig, partitions), evaluator, collector
        self._batch_size = max(1, min(MAX_BATCH_MOVES, BATCH_BYTES // (12 * rig.vertex_count)))
        self._base_residuals: np.ndarray | None = None
        self._moves: list[tuple[str, int]] = []
        self._evaluated_poses: list[tuple[np.ndarray, np.ndarray]] = []

    def set_base_pose(self) -> None:
        """Use the current pose as base pose."""
        self._base_residuals = self._residuals([self._evaluator.evaluate()[:2]])

    def add(self, kind: str, index: int) -> None:
        """Evaluate the current pose, which is the base pose with one joint or control moved."""
        self._moves.append((kind, index))
        self._evaluated_poses.append(self._evaluator.evaluate()[:2])
        if len(self._moves) == self._batch_size:
            self.flush()

    def flush(self) -> None:
        """Compare the remaining moves with the base pose, and empty the batch."""
        if self._moves:
            self._collector.add(self._moves, self._residuals(self._evaluated_poses), self._base_residuals)
        self._moves, self._evaluated_poses = [], []

    def _residuals(self, evaluated_poses: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        return self._skinning.local_residuals(*(np.stack(arrays) for arrays in zip(*evaluated_poses, strict=True)))


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
    return collector.make_partitions(rig)


def _follows_control_bones(scene_rig: SceneRig, rig: Rig, channels: tuple[Channel, ...]) -> bool:
    """Return whether joints move otherwise than by their own sampled channels."""
    sampled_names = {channel.name for channel in channels}
    bones = scene_rig.armature_object.pose.bones
    animation = scene_rig.armature_object.animation_data
    paths = [curve.data_path for curve in (animation.drivers if animation else ())]
    driven_bones = {bone for bone, _ in map(split_bone_path, paths) if bone}
    unsampled_joints = [name for name in rig.joint_names if name not in sampled_names and name != STATIC_JOINT]
    if any(name not in rig.joint_names for name in sampled_names if name in bones):
        return True
    return not sampled_names or any(
        is_moved_by_constraints(bones[name]) or name in driven_bones for name in unsampled_joints
    )


def _move_channels(scene_rig: SceneRig, rig: Rig, search: InfluenceSearch, moves: _MoveBatch) -> Iterator[Progress]:
    """Move the channels of one joint or control at a time, from the rest pose and from random poses."""
    channels, poses_per_input = search.channels, search.poses
    poser = Poser(scene_rig, channels)
    joints = {name: index for index, name in enumerate(rig.joint_names)}
    controls = {control.name: index for index, control in enumerate(rig.controls)}
    moved_bones = controls_by_bone(rig.controls)
    channel_indices: dict[tuple[str, int], list[int]] = {}
    for channel_index, channel in enumerate(channels):
        index = (controls if channel.kind == CONTROL else joints).get(channel.name)
        if index is not None:
            channel_indices.setdefault((CONTROL if channel.kind == CONTROL else "joint", index), []).append(
                channel_index
            )
        # Controls may be numbers of the transform that the channels of a bone set; they change together.
        if channel.kind != CONTROL and channel.name in moved_bones:
            channel_indices.setdefault((CONTROL, moved_bones[channel.name][0]), []).append(channel_index)
    moved_inputs = dict(sorted(channel_indices.items(), key=lambda item: (item[0][0] == CONTROL, item[0][1])))
    rest_values = np.array([channel.rest for channel in channels])
    # All joints share the base poses: the rest pose for half of the moves, random poses for the others.
    base_poses = [rest_values] * (poses_per_input - poses_per_input // 2) + [
        search.draw_values(index) for index in range(poses_per_input // 2)
    ]
    total_steps = poses_per_input * (len(moved_inputs) + 1)
    for base_index, base_values in enumerate(base_poses):
        poser.set(base_values)
        moves.set_base_pose()
        for step, ((kind, index), moved_channels) in enumerate(
            moved_inputs.items(), base_index * (len(moved_inputs) + 1) + 1
        ):
            yield Progress("influences", step, total_steps)
            values = base_values.copy()
            sample_offset = index if kind != CONTROL else len(joints) + index
            values[moved_channels] = search.draw_values((sample_offset + 1) * poses_per_input + base_index)[
                moved_channels
            ]
            poser.set(values)
            moves.add(kind, index)
        moves.flush()
        yield Progress("influences", (base_index + 1) * (len(moved_inputs) + 1), total_steps)


def _override_each_joint(
    scene_rig: SceneRig, rig: Rig, search: InfluenceSearch, collector: _InfluenceCollector, moves: _MoveBatch
) -> Iterator[Progress]:
    """Set one joint or control at a time to its state in another pose, and keep all others."""
    poses_per_input = search.poses
    states = _sample_states(scene_rig, rig, search, 2 * poses_per_input)
    clear_pose(scene_rig.armature_object)
    joint_transforms = np.stack([state.joints for state in states])
    changes = np.abs(joint_transforms - joint_transforms[0])
    changes[..., :3, 3] *= rig.metres_per_unit
    moving_joints = np.flatnonzero(changes.max(axis=(0, 2, 3)) > MIN_TRANSFORM_CHANGE).tolist()
    bones, joint_names = controls_by_bone(rig.controls), set(rig.joint_names)
    driven_controls = {n for n, c in enumerate(rig.controls) if is_driven(owner_of(scene_rig, c.owner), c.path)}
    # The transform of a joint is set with the joint.
    movable_bones = {n: c for n, c in bones.items() if n not in joint_names and driven_controls.isdisjoint(c)}
    bone_controls = {index for indices in bones.values() for index in indices}
    movable_controls = sorted(set(range(len(rig.controls))) - bone_controls - driven_controls)
    bone_of_control = {indices[0]: name for name, indices in movable_bones.items()}
    first_controls = sorted([*movable_controls, *bone_of_control])
    for control in set(range(len(rig.controls))) - set(movable_controls):
        # A control that cannot be moved alone, such as a driven property, may influence all partitions.
        if not any(control in indices for indices in movable_bones.values()):
            collector.add_to_all(control)
    moved_inputs = [("joint", index) for index in moving_joints] + [(CONTROL, index) for index in first_controls]
    with override_joints(scene_rig, rig.joints, search.has_target) as override:

        def show_pose(state: _PoseState) -> None:
            override.set(state.joints)
            for index in movable_controls:
                set_control(scene_rig, rig.controls[index].name, float(state.controls[index]))
            for name in movable_bones:
                scene_rig.armature_object.pose.bones[name].matrix_basis = state.bones[name]

        rest_state = _PoseState(override.rest, states[0].controls, dict.fromkeys(bones, Matrix()))
        base_states = [rest_state] * (poses_per_input - poses_per_input // 2) + states[: poses_per_input // 2]
        for base_index, (base_state, other_state) in enumerate(zip(base_states, states[poses_per_input:], strict=True)):
            show_pose(base_state)
            moves.set_base_pose()
            for step, (kind, index) in enumerate(moved_inputs, base_index * (len(moved_inputs) + 1) + 1):
                yield Progress("influences", step, poses_per_input * (len(moved_inputs) + 1))
                show_pose(base_state.with_input_of(other_state, kind, index, bone_of_control.get(index, "")))
                moves.add(kind, index)
            moves.flush()
            yield Progress(
                "influences", (base_index + 1) * (len(moved_inputs) + 1), poses_per_input * (len(moved_inputs) + 1)
            )


@dataclass(frozen=True)
class _PoseState:
    """State of joints and controls in a pose.

    Attributes:
        joints: (J, 4, 4) matrices relative to parent joints.
        controls: (C,) control values.
        bones: the transform of each control bone relative to its rest pose, by name.
    """

    joints: np.ndarray
    controls: np.ndarray
    bones: dict[str, Matrix]

    def with_input_of(self, other: "_PoseState", kind: str, index: int, bone: str) -> "_PoseState":
        """Return a copy in which one joint, control or control bone, if it is named, has its value in another state."""
        joints, controls, bones = self.joints.copy(), self.controls.copy(), dict(self.bones)
        if kind != CONTROL:
            joints[index] = other.joints[index]
        elif bone:
            bones[bone] = other.bones[bone]
        else:
            controls[index] = other.controls[index]
        return _PoseState(joints, controls, bones)


def _sample_states(scene_rig: SceneRig, rig: Rig, search: InfluenceSearch, count: int) -> list[_PoseState]:
    """Read the states of joints and controls in random or recorded poses."""
    poser = Poser(scene_rig, search.channels)
    override = JointOverride(scene_rig, rig.joints)
    reader = ControlReader(scene_rig, rig.controls)
    states = []
    for index in range(count):
        if search.channels:
            poser.set(search.draw_values(index))
        else:
            search.show_pose(index)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        bones = scene_rig.armature_object.evaluated_get(depsgraph).pose.bones
        transforms = {name: bones[name].matrix_basis.copy() for name in controls_by_bone(rig.controls)}
        states.append(_PoseState(override.read(), reader.read(scene_rig, depsgraph), transforms))
    search.stop_playback()
    return states
