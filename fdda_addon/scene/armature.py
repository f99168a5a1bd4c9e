# SPDX-License-Identifier: GPL-3.0-or-later
"""Armatures in and out: rest pose, pose matrices, posing."""

import bpy
import numpy as np
from mathutils import Euler, Quaternion

from ..core.poses import CONTROL, LOCATION, ROTATION, ROTATION_VECTOR, SCALE, Channel
from ..core.rig import STATIC_JOINT
from .arrays import POSE_CHANNELS, POSE_MATRIX, Reader, write
from .controls import set_control
from .scene_rig import SceneRig


def rest_matrices(armature: bpy.types.Armature, names: tuple[str, ...]) -> np.ndarray:
    """Rest matrices of bones, (J, 4, 4) float64, armature space, its units; the identity for the unmoved joint."""
    identity = np.eye(4)
    matrices = [identity if name == STATIC_JOINT else armature.bones[name].matrix_local for name in names]
    return np.array(matrices, np.float64).reshape(-1, 4, 4)


_REST_POSE = ((0, 0, 0), (0, 0, 0), (1, 0, 0, 0), (0, 0, 1, 0), (1, 1, 1))
"""Values of `POSE_CHANNELS`."""


class PoseMatrixReader:
    """Reads the pose matrices of some bones of an armature, again and again."""

    def __init__(self, armature_object: bpy.types.Object, names: tuple[str, ...]):
        """Args:
        armature_object: whose bones are meant.
        names: J bones. KeyError for a name that is not there.
        """
        index = {bone.name: number for number, bone in enumerate(armature_object.pose.bones)}
        self._count = len(index)
        # Behind the bones there is an identity, for the joint that never moves.
        order = np.array([index[name] if name != STATIC_JOINT else self._count for name in names], np.int32)
        in_a_row = np.array_equal(order, np.arange(len(order)))
        self._order = slice(0, len(order)) if in_a_row else order
        self._matrices = np.empty((self._count + 1, 4, 4), np.float32)
        self._matrices[-1] = np.eye(4)
        self._of_bones = Reader(POSE_MATRIX, self._matrices[:-1])

    def fits(self, armature_object: bpy.types.Object) -> bool:
        """Whether the armature still has as many bones."""
        return len(armature_object.pose.bones) == self._count

    def read(self, armature_object: bpy.types.Object) -> np.ndarray:
        """Pose matrices of an evaluated armature object, (J, 4, 4) float32, armature space, its units.

        A view of memory that the next call writes into. Bones must not have come or gone (`fits`).
        """
        self._of_bones.read(armature_object.pose.bones)
        # Blender keeps matrices column by column.
        return self._matrices[self._order].transpose(0, 2, 1)


def clear_pose(armature_object: bpy.types.Object) -> None:
    """Bring every bone to its rest pose."""
    bones = armature_object.pose.bones
    for channel, values in zip(POSE_CHANNELS, _REST_POSE, strict=True):
        write(bones, channel, np.tile(np.float32(values), (len(bones), 1)))
    armature_object.update_tag(refresh={"DATA"})


class Poser:
    """Sets poses given as values of channels. Bones must be at rest where no channel reaches (`clear_pose`)."""

    def __init__(self, scene_rig: SceneRig, channels: tuple[Channel, ...]):
        self._scene_rig = scene_rig
        self._places: dict[str, dict[str, list[tuple[int, int]]]] = {}
        for place, channel in enumerate(channels):
            self._places.setdefault(channel.kind, {}).setdefault(channel.name, []).append((place, channel.axis))

    def set(self, values: np.ndarray) -> None:
        """Pose the rig: (C,) values in the order of the channels, each in its unit. The graph is not evaluated."""
        bones = self._scene_rig.armature_object.pose.bones
        for name, places in self._places.get(ROTATION, {}).items():
            angles = [0.0, 0.0, 0.0]
            for place, axis in places:
                angles[axis] = values[place]
            if bones[name].rotation_mode in {"QUATERNION", "AXIS_ANGLE"}:
                _rotate(bones[name], Euler(angles).to_quaternion())
            else:
                bones[name].rotation_euler = angles
        for name, places in self._places.get(ROTATION_VECTOR, {}).items():
            vector = [0.0, 0.0, 0.0]
            for place, axis in places:
                vector[axis] = values[place]
            _rotate(bones[name], Quaternion(vector))
        for kind in (LOCATION, SCALE):
            for name, places in self._places.get(kind, {}).items():
                values_of_bone = getattr(bones[name], kind)
                for place, axis in places:
                    values_of_bone[axis] = values[place]
        for name, places in self._places.get(CONTROL, {}).items():
            set_control(self._scene_rig, name, float(values[places[0][0]]))


def _rotate(bone: bpy.types.PoseBone, rotation: Quaternion) -> None:
    """Rotate a bone relative to its rest pose, in whichever mode it rotates."""
    if bone.rotation_mode == "QUATERNION":
        bone.rotation_quaternion = rotation
    elif bone.rotation_mode == "AXIS_ANGLE":
        axis, angle = rotation.to_axis_angle()
        bone.rotation_axis_angle = (angle, *axis)
    else:
        bone.rotation_euler = rotation.to_euler(bone.rotation_mode)
