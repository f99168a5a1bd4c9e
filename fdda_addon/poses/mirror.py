# SPDX-License-Identifier: GPL-3.0-or-later
"""Poses mirrored left to right, for rigs that are the same on both sides."""

import re
from collections.abc import Iterable

import bpy
import numpy as np

from ..core.errors import RigError
from ..scene.arrays import POSE_CHANNELS, read, write
from ..scene.temporary_state import set_value
from ..scene.unit import metres_per_unit

MIN_DISTANCE, PART_OF_SIZE = 1e-3, 1e-3
"""Ends of bones may lie off their mirror image by one millimetre, or by this part of the armature's size if larger."""
AXIS_TOLERANCE = 1e-2
"""The largest angle by which the axes of a bone and of its mirror image may differ, radians."""

_SIGNS = {
    "location": (-1, 1, 1),
    "rotation_euler": (1, -1, -1),
    "rotation_quaternion": (1, 1, -1, -1),
    "rotation_axis_angle": (1, 1, -1, -1),
    "scale": (1, 1, 1),
}
_NAME = re.compile(r'\["((?:[^"\\]|\\.)*)"\]')


def flipped_name(name: str) -> str:
    """The name of the other side: `arm.R` of `arm.L`, `rig:RightArm` of `rig:LeftArm`; the same where it has none."""
    space, colon, own = name.rpartition(":")
    return space + colon + bpy.utils.flip_name(own)


class Mirror:
    """Mirrors the pose of an armature about its YZ plane, and numbers that have a left and a right."""

    def __init__(self, armature_object: bpy.types.Object, animated: Iterable[tuple[bpy.types.ID, str]] = ()):
        """Args:
            armature_object: the armature object.
            animated: numbers, datablock and RNA path, that are exchanged with those of the other side, where there are
                such; custom properties of bones are anyway.

        Raises:
            RigError: the rest pose is not the same on both sides, or two bones rotate in different modes.
        """
        self._armature_object = armature_object
        bones = armature_object.pose.bones
        index = {bone.name: number for number, bone in enumerate(bones)}
        self._partners = np.array([index.get(flipped_name(name), number) for name, number in index.items()], int)
        _check_symmetric(armature_object, self._partners)
        paths = {(armature_object, path) for path in _custom_paths(armature_object)} | set(animated)
        self._pairs = [
            (datablock, path, other)
            for datablock, path in sorted(paths, key=lambda place: place[1])
            if (other := _flipped_path(path)) != path and _is_number(datablock, path) and _is_number(datablock, other)
        ]

    @property
    def numbers(self) -> list[tuple[bpy.types.ID, str]]:
        """The numbers that are exchanged."""
        return [(datablock, each) for datablock, path, other in self._pairs for each in (path, other)]

    def apply(self) -> None:
        """Mirror the pose and the numbers as they are set now. The graph is not evaluated."""
        bones = self._armature_object.pose.bones
        for channel in POSE_CHANNELS:
            write(bones, channel, read(bones, channel)[self._partners] * np.float32(_SIGNS[channel.name]))
        values = {(datablock, other): datablock.path_resolve(path) for datablock, path, other in self._pairs}
        values |= {(datablock, path): datablock.path_resolve(other) for datablock, path, other in self._pairs}
        for (datablock, path), value in values.items():
            set_value(datablock, path, value)
        for datablock in {datablock for datablock, _ in values} | {self._armature_object}:
            # Custom properties do not tell the graph by themselves.
            datablock.update_tag()


def _check_symmetric(armature_object: bpy.types.Object, partners: np.ndarray) -> None:
    bones = armature_object.data.bones
    matrices = np.array([bone.matrix_local for bone in bones], np.float64).reshape(-1, 4, 4)
    tails = np.array([bone.tail_local for bone in bones], np.float64).reshape(-1, 3)
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    images = flip @ matrices[partners] @ flip
    ends = np.concatenate([matrices[:, :3, 3], tails])
    metres = metres_per_unit(armature_object)
    tolerance = max(MIN_DISTANCE, PART_OF_SIZE * metres * float(np.ptp(ends, axis=0).max()))
    off = metres * np.maximum(
        np.linalg.norm(images[:, :3, 3] - matrices[:, :3, 3], axis=1),
        np.linalg.norm(tails[partners] * [-1, 1, 1] - tails, axis=1),
    )
    turned = np.linalg.norm(images[:, :3, :3] - matrices[:, :3, :3], axis=1).max(axis=1)
    for number, bone in enumerate(bones):
        other = bones[int(partners[number])]
        if off[number] > tolerance:
            what = f"by {off[number] * 1000:.1f} mm"
        elif turned[number] > AXIS_TOLERANCE:
            what = f"in roll or direction, by {np.degrees(2 * np.arcsin(min(1.0, turned[number] / 2))):.1f}°"
        elif armature_object.pose.bones[bone.name].rotation_mode != _mode(armature_object, other.name):
            what = "in rotation mode"
        else:
            continue
        name, flipped = bone.name, flipped_name(bone.name)
        if other != bone:
            found = f"the bones '{name}' and '{other.name}' differ {what}; symmetrize the armature"
        elif flipped != name:
            found = f"there is no bone '{flipped}' for '{name}'; add it"
        else:
            found = f"the bone '{name}' differs from its mirror image {what}; bring it into the middle"
        raise RigError(f"'{armature_object.name}' cannot be mirrored: {found}, or leave mirroring out.")


def _mode(armature_object: bpy.types.Object, name: str) -> str:
    return armature_object.pose.bones[name].rotation_mode


def _custom_paths(armature_object: bpy.types.Object) -> list[str]:
    escape = bpy.utils.escape_identifier
    return [
        f'pose.bones["{escape(bone.name)}"]["{escape(key)}"]'
        for bone in armature_object.pose.bones
        for key in bone.keys()  # noqa: SIM118
    ]


def _flipped_path(path: str) -> str:
    def flip(match: re.Match) -> str:
        return f'["{bpy.utils.escape_identifier(flipped_name(bpy.utils.unescape_identifier(match[1])))}"]'

    return _NAME.sub(flip, path)


def _is_number(datablock: bpy.types.ID, path: str) -> bool:
    try:
        return isinstance(datablock.path_resolve(path), int | float)
    except ValueError:
        return False
