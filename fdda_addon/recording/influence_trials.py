# SPDX-License-Identifier: GPL-3.0-or-later
"""Moves joints and controls from base poses, to detect their influences.

Joints with sampled channels are moved by these channels. In a control rig, control bones move many joints at once
through constraints. So in a control rig, each joint is set to its transform in other poses, with all constraints
muted.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import bpy
import numpy as np
from mathutils import Matrix

from ..core.defaults import INFLUENCE_POSES
from ..core.mathematics.partition import INFLUENCE_TOLERANCE
from ..core.mathematics.poses import CONTROL, Channel
from ..core.rig import STATIC_JOINT, Rig
from ..poses.bone_channels import is_moved_by_constraints
from ..rig.bone_paths import split_bone_path
from ..scene.armature import Poser, clear_pose
from ..scene.bone_transform import controls_by_bone
from ..scene.control_reader import ControlReader
from ..scene.controls import is_driven, owner_of, set_control
from ..scene.scene_rig import SceneRig
from .joint_override import JointOverride, override_joints

JOINT = "joint"
"""Kind of an input that is a joint; the other kind is `CONTROL`."""
MIN_DRAWN_POSES = 20
"""Smallest number of drawn poses. In a trial, each input moves to its value in the one that is farthest from the base
pose: large motions show more influences, so few trials are enough."""
MIN_CHANNEL_RANGE = 1e-12
"""Range of a channel that does not move, so that nothing is divided by zero; in the unit of the channel."""
MIN_TRANSFORM_CHANGE = 1e-5
"""Smallest change of a joint's relative transform between poses that counts as motion (no unit, or meters)."""


@dataclass(frozen=True)
class InfluenceSearch:
    """Settings of the detection of influences.

    Attributes:
        channels: channels of the random poses; may be empty.
        draw_values: returns random values of the channels, (C,), for an index from 0.
        show_pose: sets a recorded pose for an index from 0; used without channels.
        stop_playback: ends the playback of `show_pose`.
        has_target: the surface is that of a target.
        has_other_bones: bones other than the joints may deform the surface, because it is that of a target, or because
            the joints are key joints.
        poses: number of base poses, from each of which every joint is moved: the rest pose, then random poses.
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
    has_other_bones: bool = False

    @property
    def drawn_poses(self) -> int:
        """Number of poses that are drawn, as base poses and for the values to which inputs move."""
        return max(MIN_DRAWN_POSES, self.poses)


class Trials(Protocol):
    """A base pose for each trial, and for each trial and input a value to which the input moves.

    Attributes:
        inputs: kind, and index of the joint or control, of each input that moves.
        undetectable_controls: controls that cannot be moved alone, so that they may influence all partitions.
    """

    inputs: list[tuple[str, int]]
    undetectable_controls: frozenset[int]

    def show(self, trial: int, moved: int | None) -> None:
        """Set the base pose of a trial, with the input at the index `moved` moved."""


@contextmanager
def prepared_trials(scene_rig: SceneRig, rig: Rig, search: InfluenceSearch) -> Iterator[Trials]:
    """Prepare the trials of a rig; clear the pose of the armature afterwards."""
    # Channels do not move the other joints that have a joint as their reference joint.
    has_references = any(joint.reference is not None for joint in rig.joints)
    if not has_references and not follows_control_bones(scene_rig, rig, search.channels):
        yield _ChannelTrials(scene_rig, rig, search)
    else:
        states = _sample_states(scene_rig, rig, search, search.drawn_poses)
        clear_pose(scene_rig.armature_object)
        with override_joints(scene_rig, rig.joints, search.has_other_bones) as override:
            yield _OverrideTrials(scene_rig, rig, states, override, search.poses)
    clear_pose(scene_rig.armature_object)


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


class _ChannelTrials:
    """Trials that move joints and controls by their sampled channels."""

    def __init__(self, scene_rig: SceneRig, rig: Rig, search: InfluenceSearch):
        channels = search.channels
        self.undetectable_controls = frozenset()
        self._search, self._poser = search, Poser(scene_rig, channels)
        joints = {name: index for index, name in enumerate(rig.joint_names)}
        controls = {c.name: index for index, c in enumerate(rig.controls) if not c.is_shape_key}
        moved_bones = controls_by_bone(rig.controls)
        channel_indices: dict[tuple[str, int], list[int]] = {}
        for channel_index, channel in enumerate(channels):
            index = (controls if channel.kind == CONTROL else joints).get(channel.name)
            if index is not None:
                kind = CONTROL if channel.kind == CONTROL else JOINT
                channel_indices.setdefault((kind, index), []).append(channel_index)
            # Controls may be numbers of the transform that the channels of a bone set; they change together.
            if channel.kind != CONTROL and channel.name in moved_bones:
                channel_indices.setdefault((CONTROL, moved_bones[channel.name][0]), []).append(channel_index)
        self.inputs = sorted(channel_indices, key=lambda item: (item[0] == CONTROL, item[1]))
        self._channels_of_inputs = [channel_indices[moved_input] for moved_input in self.inputs]
        poses = np.stack([search.draw_values(index) for index in range(search.drawn_poses)])
        rest_values = np.array([channel.rest for channel in channels])
        self._base_poses = np.stack([rest_values, *poses[: search.poses - 1]])
        ranges = np.maximum(np.ptp(poses, axis=0), MIN_CHANNEL_RANGE)
        distances = np.square((poses - self._base_poses[:, None]) / ranges)  # (base pose, pose, channel)
        self._moved_poses = [
            poses[distances[..., indices].sum(axis=2).argmax(axis=1)] for indices in self._channels_of_inputs
        ]

    def show(self, trial: int, moved: int | None) -> None:
        values = self._base_poses[trial].copy()
        if moved is not None:
            indices = self._channels_of_inputs[moved]
            values[indices] = self._moved_poses[moved][trial, indices]
        self._poser.set(values)


class _OverrideTrials:
    """Trials that set joints and controls to their values in other poses, and keep all others."""

    def __init__(
        self,
        scene_rig: SceneRig,
        rig: Rig,
        states: "list[_PoseState]",
        override: JointOverride,
        trial_count: int,
    ):
        self._scene_rig, self._rig, self._override = scene_rig, rig, override
        joint_transforms = np.stack([state.joints for state in states])
        changes = np.abs(joint_transforms - joint_transforms[0])
        changes[..., :3, 3] *= rig.metres_per_unit
        moving_joints = np.flatnonzero(changes.max(axis=(0, 2, 3)) > MIN_TRANSFORM_CHANGE).tolist()
        bones, joint_names = controls_by_bone(rig.controls), set(rig.joint_names)
        shape_keys = {index for index, control in enumerate(rig.controls) if control.is_shape_key}
        other_controls = set(range(len(rig.controls))) - shape_keys
        driven_controls = {
            index
            for index in other_controls
            if is_driven(owner_of(scene_rig, rig.controls[index].owner), rig.controls[index].path)
        }
        # The transform of a joint is set with the joint.
        self._movable_bones = {
            name: indices
            for name, indices in bones.items()
            if name not in joint_names and driven_controls.isdisjoint(indices)
        }
        bone_controls = {index for indices in bones.values() for index in indices}
        movable_bone_controls = {index for indices in self._movable_bones.values() for index in indices}
        self._movable_controls = sorted(other_controls - bone_controls - driven_controls)
        self._bone_of_control = {indices[0]: name for name, indices in self._movable_bones.items()}
        self.undetectable_controls = frozenset(other_controls) - movable_bone_controls
        self.undetectable_controls -= frozenset(self._movable_controls)
        self.inputs = [(JOINT, index) for index in moving_joints]
        self.inputs += [(CONTROL, index) for index in sorted([*self._movable_controls, *self._bone_of_control])]
        rest_state = _PoseState(override.rest, states[0].controls, dict.fromkeys(bones, Matrix()))
        self._base_states = [rest_state, *states][:trial_count]
        values = np.stack([self._input_values(state) for state in states])
        self._moved_states = []
        for base_state in self._base_states:
            distances = np.square(values - self._input_values(base_state)).sum(axis=2)
            self._moved_states.append([states[index] for index in distances.argmax(axis=0)])

    def _input_values(self, state: "_PoseState") -> np.ndarray:
        """Return the values of all inputs in a state, (N, 16); lengths relative to the size of the rig."""
        values = np.zeros((len(self.inputs), 4, 4))
        for number, (kind, index) in enumerate(self.inputs):
            if kind == JOINT:
                values[number] = state.joints[index]
            elif index in self._bone_of_control:
                values[number] = np.array(state.bones[self._bone_of_control[index]])
            else:
                values[number, 0, 0] = state.controls[index]
        values[:, :3, 3] /= self._rig.size
        return values.reshape(-1, 16)

    def show(self, trial: int, moved: int | None) -> None:
        state = self._base_states[trial].copy()
        if moved is not None:
            kind, index = self.inputs[moved]
            moved_state = self._moved_states[trial][moved]
            if kind == JOINT:
                state.joints[index] = moved_state.joints[index]
            elif index in self._bone_of_control:
                bone = self._bone_of_control[index]
                state.bones[bone] = moved_state.bones[bone]
            else:
                state.controls[index] = moved_state.controls[index]
        self._override.set(state.joints)
        for index in self._movable_controls:
            set_control(self._scene_rig, self._rig.controls[index].name, float(state.controls[index]))
        for name in self._movable_bones:
            self._scene_rig.armature_object.pose.bones[name].matrix_basis = state.bones[name]


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

    def copy(self) -> "_PoseState":
        return _PoseState(self.joints.copy(), self.controls.copy(), dict(self.bones))


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
