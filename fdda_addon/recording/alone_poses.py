# SPDX-License-Identifier: GPL-3.0-or-later
"""Plans and sets the poses in which one input, a joint or a control, moves alone from a base pose.

They show which inputs influence which vertices (Bailey et al. 2018, section 3.3). Joints with sampled channels are
moved by these channels. In a control rig, control bones move many joints at once through constraints. So in a control
rig, each joint is set to its transform in another pose, with all constraints muted.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace

import bpy
import numpy as np
from mathutils import Matrix

from ..core.errors import RigError
from ..core.mathematics.partition import GOLDEN_RATIO
from ..core.mathematics.poses import CONTROL, Channel
from ..core.recording.index import JOINT, AloneMoves
from ..core.rig import STATIC_JOINT, Joint, Rig, reference_order
from ..poses.clip import Clip
from ..poses.clip_player import ClipPlayer
from ..poses.motion_range import is_moved_by_constraints
from ..rig.references import ik_chain, is_transform_channel, split_bone_path
from ..rig.shape_keys import muted_key_drivers
from ..scene.armature import PoseMatrixReader, Poser, clear_pose, rest_matrices
from ..scene.control_reader import ControlReader
from ..scene.controls import controls_by_bone, is_driven, number_at, owner_of, set_control
from ..scene.scene_rig import MIN_VOLUME, SceneRig, is_flat
from .plan import RecordingSettings, make_pose_sampler

SEED_OFFSET = 1 << 32
"""Offset of the indices of the drawn poses, larger than any pose index of a recording."""
MIN_DRAWN_POSES = 20
"""Smallest number of drawn poses. Each input moves to its value in the one that is farthest from the base pose: large
motions show more influences, so few base poses are enough."""
MIN_CHANNEL_RANGE = 1e-12
"""Range of a channel that does not move, so that nothing is divided by zero; in the unit of the channel."""
MIN_TRANSFORM_CHANGE = 1e-5
"""Smallest change of a joint's relative transform between poses that counts as motion (no unit, or meters)."""
_PARENT_CONSTRAINTS = {"CHILD_OF", "ARMATURE"}
"""Constraints that move a bone as a parent does."""


class JointOverride:
    """Reads joints of evaluated poses, and sets each joint alone.

    Attributes:
        rest: (J, 4, 4) float64, rest matrix of each joint relative to its reference joint, mesh units.
    """

    def __init__(self, scene_rig: SceneRig, joints: tuple[Joint, ...]):
        """Prepare to read and set joints.

        Args:
            joints: J joints, every parent before its children.
        """
        self._armature_object = scene_rig.armature_object
        self._joints, self._order = joints, reference_order(joints)
        self._carried_bones = {
            bone.name
            for bone in scene_rig.armature_object.pose.bones
            if not bone.parent and not any(constraint.type in _PARENT_CONSTRAINTS for constraint in bone.constraints)
        }
        names = tuple(joint.name for joint in joints)
        self._matrix_reader = PoseMatrixReader(scene_rig.armature_object, names)
        self.rest = self._to_relative_matrices(rest_matrices(scene_rig.armature_object.data, names))

    def read(self) -> np.ndarray:
        """Read the evaluated matrix of each joint relative to its reference joint; (J, 4, 4) float64, mesh units.

        Raises:
            RigError: the armature, or a bone, has a scale of zero.
        """
        armature_object = self._armature_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
        matrices = self._matrix_reader.read(armature_object).astype(np.float64)
        is_singular = np.abs(np.linalg.det(matrices[:, :3, :3])) < MIN_VOLUME
        if is_flat(armature_object) or is_singular.any():
            name = armature_object.name if is_flat(armature_object) else self._joints[int(is_singular.argmax())].name
            raise RigError(
                f"'{name}' has a scale of zero in some pose; look for the key, constraint or driver that sets it."
            )
        return self._to_relative_matrices(matrices)

    def _to_relative_matrices(self, matrices: np.ndarray) -> np.ndarray:
        references = [joint.parent if joint.reference is None else joint.reference for joint in self._joints]
        return np.array(
            [np.linalg.solve(matrices[r], m) if r >= 0 else m for r, m in zip(references, matrices, strict=True)]
        )

    def set(self, relative_matrices: np.ndarray) -> None:
        """Set the joints to (J, 4, 4) matrices as `read` returns them, in `override_joints`, without an evaluation."""
        target_matrices: dict[str, Matrix] = {}
        for index in self._order:
            joint, matrix = self._joints[index], Matrix(relative_matrices[index])
            reference = joint.parent if joint.reference is None else joint.reference
            target_matrices[joint.name] = (
                target_matrices[self._joints[reference].name] @ matrix if reference >= 0 else matrix
            )
        target_matrices.pop(STATIC_JOINT, None)
        # The joint without a reference joint carries the whole rig, so bones that nothing else moves follow it.
        root = self._joints[self._order[0]].name
        root_motion = target_matrices[root] @ self._armature_object.data.bones[root].matrix_local.inverted()
        pose_matrices: dict[str, Matrix] = {}
        for bone in self._armature_object.pose.bones:
            bone_data = bone.bone
            parent = bone_data.parent
            parent_matrices = (
                {"parent_matrix": pose_matrices[parent.name], "parent_matrix_local": parent.matrix_local}
                if parent
                else {}
            )
            if bone_data.name in target_matrices:
                pose_matrices[bone_data.name] = target_matrices[bone_data.name]
                bone.matrix_basis = bone_data.convert_local_to_pose(
                    target_matrices[bone_data.name], bone_data.matrix_local, invert=True, **parent_matrices
                )
            elif bone_data.name in self._carried_bones:
                pose_matrices[bone_data.name] = root_motion @ bone_data.matrix_local
                bone.matrix_basis = bone_data.matrix_local.inverted() @ pose_matrices[bone_data.name]
            else:
                pose_matrices[bone_data.name] = bone_data.convert_local_to_pose(
                    Matrix(), bone_data.matrix_local, **parent_matrices
                )


@contextmanager
def override_joints(
    scene_rig: SceneRig, joints: tuple[Joint, ...], keep_other_bones: bool = False
) -> Iterator[JointOverride]:
    """Mute constraints and drivers of bones, so that only their channels move them; restore both afterwards.

    Clear the pose before (`armature.clear_pose`). The last pose that was set stays afterwards.

    Args:
        joints: as for `JointOverride`.
        keep_other_bones: do not mute constraints and drivers of bones that are neither joints nor ancestors of joints.
    """
    armature_object = scene_rig.armature_object
    animation = armature_object.animation_data
    names = {joint.name for joint in joints}
    bones = [bone for bone in armature_object.pose.bones if bone.name in names]
    joints_and_ancestors = {ancestor.name for bone in bones for ancestor in (bone, *bone.parent_recursive)}

    def is_overridden(name: str) -> bool:
        return not keep_other_bones or name in joints_and_ancestors

    constraints = [
        constraint
        for bone in armature_object.pose.bones
        for constraint in bone.constraints
        if not constraint.mute and (is_overridden(bone.name) or ik_chain(bone, constraint))
    ]
    drivers = [
        curve
        for curve in (animation.drivers if animation else ())
        for bone, channel_path in [split_bone_path(armature_object, curve.data_path)]
        if bone and is_transform_channel(channel_path) and is_overridden(bone) and not curve.mute
    ]
    override = JointOverride(scene_rig, joints)
    for constraint_or_driver in (*constraints, *drivers):
        constraint_or_driver.mute = True
    try:
        yield override
    finally:
        for constraint_or_driver in (*constraints, *drivers):
            constraint_or_driver.mute = False
        bpy.context.view_layer.update()


class AlonePosePlan:
    """Poses that move one input at a time, by their sampled channels; `_OverridePlan` moves those of a control rig.

    Attributes:
        description: the poses, as the recording describes them.
    """

    def __init__(self, scene_rig: SceneRig, rig: Rig, channels: tuple[Channel, ...], poses: np.ndarray, bases: int):
        """Plan the poses.

        Args:
            channels: C channels.
            poses: (N, C) drawn poses.
            bases: number of base poses: the rest pose, then drawn poses.
        """
        self._scene_rig, self._rig, self._poser = scene_rig, rig, Poser(scene_rig, channels)
        joints = {name: index for index, name in enumerate(rig.joint_names)}
        controls = {control.name: index for index, control in enumerate(rig.controls) if not control.is_shape_key}
        # Controls may be numbers of the transform that the channels of a bone set; they change together.
        moved_bones = controls_by_bone(rig.controls)
        control_groups = {index: indices for indices in moved_bones.values() for index in indices}
        moved_channels: dict[tuple[str, tuple[int, ...]], list[int]] = {}
        for channel_index, channel in enumerate(channels):
            groups: list[tuple[str, tuple[int, ...]]] = []
            if channel.kind == CONTROL and channel.name in controls:
                index = controls[channel.name]
                groups.append((CONTROL, control_groups.get(index, (index,))))
            elif channel.kind != CONTROL:
                groups += [(JOINT, (joints[channel.name],))] if channel.name in joints else []
                groups += [(CONTROL, moved_bones[channel.name])] if channel.name in moved_bones else []
            for group in groups:
                moved_channels.setdefault(group, []).append(channel_index)
        inputs = sorted(moved_channels, key=lambda moved: (moved[0] == CONTROL, moved[1]))
        self.description = AloneMoves(bases, tuple(inputs))
        self._channels_of_inputs = [moved_channels[moved] for moved in inputs]
        rest_values = np.array([channel.rest for channel in channels])
        self._base_poses = np.stack([rest_values, *poses[: bases - 1]])
        ranges = np.maximum(np.ptp(poses, axis=0), MIN_CHANNEL_RANGE)
        distances = np.square((poses - self._base_poses[:, None]) / ranges)  # (base pose, pose, channel)
        self._moved_poses = [
            poses[distances[..., indices].sum(axis=2).argmax(axis=1)] for indices in self._channels_of_inputs
        ]

    def show_poses(self, start: int = 0) -> Iterator[int]:
        """Set the poses from an index on, one for each iteration, and yield the indices; clear the pose afterwards."""
        scene_rig, moves = self._scene_rig, self.description
        clear_pose(scene_rig.armature_object)
        # The effect of shape keys is that of their values, not of the joints that drive these.
        with ExitStack() as stack:
            for mesh_object in scene_rig.mesh_objects:
                stack.enter_context(muted_key_drivers(mesh_object))
            stack.enter_context(self._prepared())
            for index in range(start, moves.first_key_pose):
                base, moved = divmod(index, len(moves.inputs) + 1)
                self._set_pose(base, moved - 1 if moved else None)
                yield index
            self._set_pose(0, None)
            for index in range(max(start, moves.first_key_pose), moves.poses):
                key = self._rig.controls[moves.keys[index - moves.first_key_pose]]
                value = number_at(owner_of(scene_rig, key.owner), key.path)
                set_control(scene_rig, key.name, max(key.low, key.high, key=lambda end: abs(end - value)))
                yield index
                set_control(scene_rig, key.name, value)
        clear_pose(scene_rig.armature_object)

    def add_shape_keys(self, has_target: bool) -> None:
        """Add the values of shape keys to the inputs; any may move a target."""
        indices = tuple(index for index, control in enumerate(self._rig.controls) if control.is_shape_key)
        name = "undetectable" if has_target else "keys"
        self.description = replace(self.description, **{name: getattr(self.description, name) + indices})

    @contextmanager
    def _prepared(self) -> Iterator[None]:
        yield

    def _set_pose(self, base: int, moved: int | None) -> None:
        """Set a base pose, with the input at the index `moved` moved."""
        values = self._base_poses[base].copy()
        if moved is not None:
            indices = self._channels_of_inputs[moved]
            values[indices] = self._moved_poses[moved][base, indices]
        self._poser.set(values)


@dataclass(frozen=True)
class _PoseState:
    """State of joints and controls in a pose.

    Attributes:
        joints: (J, 4, 4) matrices relative to reference joints.
        controls: (C,) control values.
        bones: the transform of each control bone relative to its rest pose, by name.
    """

    joints: np.ndarray
    controls: np.ndarray
    bones: dict[str, Matrix]


class _OverridePlan(AlonePosePlan):
    """Poses that set one joint or control to its value in another pose, and keep all others."""

    def __init__(self, scene_rig: SceneRig, rig: Rig, states: list[_PoseState], bases: int, has_target: bool):
        """Plan the poses, given the states of the drawn poses."""
        self._scene_rig, self._rig, self._has_target = scene_rig, rig, has_target
        joint_transforms = np.stack([state.joints for state in states])
        changes = np.abs(joint_transforms - joint_transforms[0])
        changes[..., :3, 3] *= rig.metres_per_unit
        moving_joints = np.flatnonzero(changes.max(axis=(0, 2, 3)) > MIN_TRANSFORM_CHANGE).tolist()
        bones, joint_names = controls_by_bone(rig.controls), set(rig.joint_names)
        numbers = {index for index, control in enumerate(rig.controls) if not control.is_shape_key}
        driven_controls = {
            index
            for index in numbers
            if is_driven(owner_of(scene_rig, rig.controls[index].owner), rig.controls[index].path)
        }
        # The transform of a joint is set with the joint.
        self._movable_bones = {
            indices: name
            for name, indices in bones.items()
            if name not in joint_names and driven_controls.isdisjoint(indices)
        }
        bone_controls = {index for indices in bones.values() for index in indices}
        self._movable_controls = sorted(numbers - bone_controls - driven_controls)
        groups = sorted([*((index,) for index in self._movable_controls), *self._movable_bones])
        undetectable = numbers.difference(*groups)
        inputs = [(JOINT, (joint,)) for joint in moving_joints] + [(CONTROL, indices) for indices in groups]
        self.description = AloneMoves(bases, tuple(inputs), undetectable=tuple(sorted(undetectable)))
        rest = JointOverride(scene_rig, rig.joints).rest
        self._base_states = [_PoseState(rest, states[0].controls, dict.fromkeys(bones, Matrix())), *states][:bases]
        values = np.stack([self._input_values(state) for state in states])
        self._moved_states = []
        for base_state in self._base_states:
            distances = np.square(values - self._input_values(base_state)).sum(axis=2)
            self._moved_states.append([states[index] for index in distances.argmax(axis=0)])

    def _input_values(self, state: _PoseState) -> np.ndarray:
        """Return the values of all inputs in a state, (N, 16); lengths relative to the size of the rig."""
        values = np.zeros((len(self.description.inputs), 4, 4))
        for number, (kind, indices) in enumerate(self.description.inputs):
            if kind == JOINT:
                values[number] = state.joints[indices[0]]
            elif indices in self._movable_bones:
                values[number] = np.array(state.bones[self._movable_bones[indices]])
            else:
                values[number, 0, 0] = state.controls[indices[0]]
        values[:, :3, 3] /= self._rig.size
        return values.reshape(-1, 16)

    @contextmanager
    def _prepared(self) -> Iterator[None]:
        with override_joints(self._scene_rig, self._rig.joints, self._has_target) as self._override:
            yield

    def _set_pose(self, base: int, moved: int | None) -> None:
        state = self._base_states[base]
        joints, controls, bones = state.joints.copy(), state.controls.copy(), dict(state.bones)
        if moved is not None:
            kind, indices = self.description.inputs[moved]
            moved_state, index = self._moved_states[base][moved], indices[0]
            if kind == JOINT:
                joints[index] = moved_state.joints[index]
            elif indices in self._movable_bones:
                bones[self._movable_bones[indices]] = moved_state.bones[self._movable_bones[indices]]
            else:
                controls[index] = moved_state.controls[index]
        self._override.set(joints)
        for index in self._movable_controls:
            set_control(self._scene_rig, self._rig.controls[index].name, float(controls[index]))
        for name in self._movable_bones.values():
            self._scene_rig.armature_object.pose.bones[name].matrix_basis = bones[name]


def plan_alone_poses(
    scene_rig: SceneRig,
    rig: Rig,
    channels: tuple[Channel, ...],
    settings: RecordingSettings,
    clips: tuple[Clip, ...],
    player: ClipPlayer,
    has_target: bool,
) -> AlonePosePlan:
    """Plan the poses of a rig that move one input at a time; clear the pose of the armature afterwards.

    Args:
        scene_rig, rig: the rig, prepared by `temporary_rig_state`, with its reference joints.
        channels: channels of the random poses; may be empty.
        settings: settings of the recording.
        clips: the clips of the recording; without channels, the drawn poses are frames of these.
        player: player of the clips.
        has_target: the surface is that of a target, so bones other than the joints may deform it.
    """
    count, sampler = max(MIN_DRAWN_POSES, settings.influence_poses), make_pose_sampler(scene_rig, settings)
    poses = [sampler.draw_pose(channels, SEED_OFFSET + index) for index in range(count)] if channels else []
    # Channels do not move the other joints that have a joint as their reference joint.
    has_references = any(joint.reference is not None for joint in rig.joints)
    if not has_references and not follows_control_bones(scene_rig, rig, channels):
        plan = AlonePosePlan(scene_rig, rig, channels, np.stack(poses), settings.influence_poses)
        plan.add_shape_keys(has_target)
        return plan
    frames, poser = [(clip, frame) for clip in clips for frame in clip.frames], Poser(scene_rig, channels)
    override, reader = JointOverride(scene_rig, rig.joints), ControlReader(scene_rig, rig.controls)
    states = []
    for index in range(count):
        if channels:
            poser.set(poses[index])
        else:
            # Consecutive indices result in frames that are far apart.
            player.show(*frames[int(index * GOLDEN_RATIO * len(frames)) % len(frames)])
        depsgraph = bpy.context.evaluated_depsgraph_get()
        bones = scene_rig.armature_object.evaluated_get(depsgraph).pose.bones
        transforms = {name: bones[name].matrix_basis.copy() for name in controls_by_bone(rig.controls)}
        states.append(_PoseState(override.read(), reader.read(scene_rig, depsgraph), transforms))
    player.stop()
    clear_pose(scene_rig.armature_object)
    plan = _OverridePlan(scene_rig, rig, states, settings.influence_poses, has_target)
    plan.add_shape_keys(has_target)
    return plan


def follows_control_bones(scene_rig: SceneRig, rig: Rig, channels: tuple[Channel, ...]) -> bool:
    """Return whether joints move otherwise than by their own sampled channels."""
    sampled_names = {channel.name for channel in channels}
    bones = scene_rig.armature_object.pose.bones
    animation = scene_rig.armature_object.animation_data
    drivers = animation.drivers if animation else ()
    driven_bones = {split_bone_path(scene_rig.armature_object, curve.data_path)[0] for curve in drivers}
    unsampled_joints = [name for name in rig.joint_names if name not in sampled_names and name != STATIC_JOINT]
    # Bones that only drive shape keys move no joint.
    other_bones = {name for name in sampled_names if name in bones} - set(rig.joint_names)
    joint_names = [name for name in rig.joint_names if name != STATIC_JOINT]
    if any(parent.name in other_bones for name in joint_names for parent in bones[name].bone.parent_recursive):
        return True
    return not sampled_names or any(
        is_moved_by_constraints(bones[name]) or name in driven_bones
        for name in (joint_names if other_bones else unsampled_joints)
    )
