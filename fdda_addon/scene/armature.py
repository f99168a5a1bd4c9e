# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads rest poses and pose matrices of armatures, and sets poses."""

import bpy
import numpy as np
from mathutils import Euler, Quaternion

from ..core.mathematics.poses import CONTROL, LOCATION, ROTATION, ROTATION_VECTOR, SCALE, Channel
from ..core.rig import STATIC_JOINT
from .arrays import POSE_CHANNELS, POSE_MATRIX_ELEMENT, read, write
from .controls import set_control
from .scene_rig import SceneRig


def rest_matrices(armature: bpy.types.Armature, names: tuple[str, ...]) -> np.ndarray:
    """Read the rest matrices of bones.

    Returns:
        (J, 4, 4) float64, armature space, armature units; the identity for the static joint.
    """
    identity = np.eye(4)
    matrices = [identity if name == STATIC_JOINT else armature.bones[name].matrix_local for name in names]
    return np.array(matrices, np.float64).reshape(-1, 4, 4)


FOUR_COMPONENT_ROTATIONS = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}
"""Property of the rotation of a pose bone, by rotation mode; of a bone with Euler angles it is `rotation_euler`."""
_REST_CHANNEL_VALUES = ((0, 0, 0), (0, 0, 0), (1, 0, 0, 0), (0, 0, 1, 0), (1, 1, 1))
"""The values of `POSE_CHANNELS` in the rest pose."""
_STORED_CHANNELS = {LOCATION: POSE_CHANNELS[0], ROTATION: POSE_CHANNELS[1], SCALE: POSE_CHANNELS[4]}
"""The property in which Blender stores the channels of a kind; rotations of bones whose mode is one of Euler angles."""


class PoseMatrixReader:
    """Reads the pose matrices of bones into an array that it reuses."""

    def __init__(self, armature_object: bpy.types.Object, names: tuple[str, ...]):
        """Prepare to read bones.

        Args:
            names: names of J bones.
        """
        bone_indices = {bone.name: bone_index for bone_index, bone in enumerate(armature_object.pose.bones)}
        self._bone_count = len(bone_indices)
        # The matrix after those of the bones is the identity, for the static joint.
        matrix_indices = np.array(
            [bone_indices[name] if name != STATIC_JOINT else self._bone_count for name in names], np.int32
        )
        is_consecutive = np.array_equal(matrix_indices, np.arange(len(matrix_indices)))
        self._matrix_indices = slice(0, len(matrix_indices)) if is_consecutive else matrix_indices
        self._matrices = np.empty((self._bone_count + 1, 4, 4), np.float32)
        self._matrices[-1] = np.eye(4)

    def fits(self, armature_object: bpy.types.Object) -> bool:
        """Return whether the armature still has the same number of bones."""
        return len(armature_object.pose.bones) == self._bone_count

    def read(self, armature_object: bpy.types.Object) -> np.ndarray:
        """Read the pose matrices of an evaluated armature object, whose number of bones must not have changed (`fits`).

        Returns:
            (J, 4, 4) float32, armature space, armature units. The next call may overwrite the array.
        """
        read(armature_object.pose.bones, POSE_MATRIX_ELEMENT, self._matrices[:-1])
        # Blender stores matrices in column-major order.
        return self._matrices[self._matrix_indices].transpose(0, 2, 1)


def clear_pose(armature_object: bpy.types.Object) -> None:
    """Set every bone to its rest pose."""
    bones = armature_object.pose.bones
    for channel, values in zip(POSE_CHANNELS, _REST_CHANNEL_VALUES, strict=True):
        write(bones, channel, np.tile(np.float32(values), (len(bones), 1)))
    armature_object.update_tag(refresh={"DATA"})


def pose_values(armature_object: bpy.types.Object) -> np.ndarray:
    """Return the values of all properties that define the pose, (B, 17) float32, in the order of the bones."""
    bones = armature_object.pose.bones
    return np.concatenate([read(bones, channel) for channel in POSE_CHANNELS], axis=1)


class Poser:
    """Sets the channels of a pose. All other channels must be in the rest pose (`clear_pose`)."""

    def __init__(self, scene_rig: SceneRig, channels: tuple[Channel, ...]):
        self._scene_rig = scene_rig
        bones = scene_rig.armature_object.pose.bones
        bone_indices = {bone.name: bone_index for bone_index, bone in enumerate(bones)}
        stored_as_euler = {bone.name for bone in bones if bone.rotation_mode not in FOUR_COMPONENT_ROTATIONS}
        self._controls: list[tuple[str, int]] = []
        """Name and index of each channel of a control."""
        self._rotations: dict[tuple[str, str], list[tuple[int, int]]] = {}
        """Index and axis of the channels that are converted to the rotation mode of their bone, by kind and bone."""
        elements: dict[str, list[tuple[int, int, int]]] = {}
        for index, channel in enumerate(channels):
            if channel.kind == CONTROL:
                self._controls.append((channel.name, index))
            elif channel.kind == ROTATION_VECTOR or (channel.kind == ROTATION and channel.name not in stored_as_euler):
                self._rotations.setdefault((channel.kind, channel.name), []).append((index, channel.axis))
            else:
                elements.setdefault(channel.kind, []).append((bone_indices[channel.name], channel.axis, index))
        self._elements = [(_STORED_CHANNELS[kind], *np.array(indices).T) for kind, indices in elements.items()]
        """Each stored property with the bones, axes and indices of its channels."""

    def set(self, values: np.ndarray) -> None:
        """Set the channels, without an evaluation.

        Args:
            values: (C,) values in the order of the channels, each in its unit.
        """
        armature_object = self._scene_rig.armature_object
        bones = armature_object.pose.bones
        for element, bone_indices, axes, indices in self._elements:
            stored = read(bones, element)
            stored[bone_indices, axes] = values[indices]
            write(bones, element, stored)
        for (kind, name), channels in self._rotations.items():
            angles = [0.0, 0.0, 0.0]
            for index, axis in channels:
                angles[axis] = values[index]
            rotate_bone(bones[name], Euler(angles).to_quaternion() if kind == ROTATION else Quaternion(angles))
        if self._elements:
            # Blender does not notice values that are written as an array.
            armature_object.update_tag(refresh={"DATA"})
        for name, index in self._controls:
            set_control(self._scene_rig, name, float(values[index]))


def rotate_bone(bone: bpy.types.PoseBone, rotation: Quaternion) -> None:
    """Set the rotation of a bone relative to its rest pose, in its rotation mode."""
    if bone.rotation_mode == "QUATERNION":
        bone.rotation_quaternion = rotation
    elif bone.rotation_mode == "AXIS_ANGLE":
        axis, angle = rotation.to_axis_angle()
        bone.rotation_axis_angle = (angle, *axis)
    else:
        bone.rotation_euler = rotation.to_euler(bone.rotation_mode)
