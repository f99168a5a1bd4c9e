# SPDX-License-Identifier: GPL-3.0-or-later
"""Mirrors poses left to right, for symmetric rigs."""

import re
from collections.abc import Iterable

import bpy
import numpy as np

from ..core.errors import RigError
from ..scene.animated_values import set_value
from ..scene.arrays import POSE_CHANNELS, read, write
from ..scene.unit import metres_per_unit

MIN_DISTANCE_TOLERANCE, RELATIVE_DISTANCE_TOLERANCE = 1e-3, 1e-3
"""Largest distance between an end of a bone and its mirror image: the larger of a distance in meters and a ratio of the
armature's size."""
AXIS_TOLERANCE = 1e-2
"""Largest angle between an axis of a bone and the same axis of its mirror image, radians."""

_MIRROR_SIGNS = {
    "location": (-1, 1, 1),
    "rotation_euler": (1, -1, -1),
    "rotation_quaternion": (1, 1, -1, -1),
    "rotation_axis_angle": (1, 1, -1, -1),
    "scale": (1, 1, 1),
}
_QUOTED_NAME = re.compile(r'\["((?:[^"\\]|\\.)*)"\]')


def flipped_name(name: str) -> str:
    """Return the name for the other side, such as `arm.R` for `arm.L`; a name without a side is returned unchanged."""
    namespace, colon, base_name = name.rpartition(":")
    return namespace + colon + bpy.utils.flip_name(base_name)


class Mirror:
    """Mirrors the pose of an armature about its YZ plane, and numbers that have a left and a right side."""

    def __init__(self, armature_object: bpy.types.Object, animated_numbers: Iterable[tuple[bpy.types.ID, str]] = ()):
        """Prepare to mirror poses.

        Args:
            animated_numbers: datablocks and RNA paths of numbers to exchange with the other side, in addition to
                custom properties of bones.
        """
        self._armature_object = armature_object
        indices = {bone.name: index for index, bone in enumerate(armature_object.pose.bones)}
        self._partner_indices = np.array(
            [indices.get(flipped_name(name), index) for name, index in indices.items()], int
        )
        # Check that each bone is the mirror image of its partner.
        partner_indices, bones = self._partner_indices, armature_object.data.bones
        matrices = np.array([bone.matrix_local for bone in bones], np.float64).reshape(-1, 4, 4)
        tails = np.array([bone.tail_local for bone in bones], np.float64).reshape(-1, 3)
        reflection = np.diag([-1.0, 1.0, 1.0, 1.0])
        mirror_images = reflection @ matrices[partner_indices] @ reflection
        bone_ends = np.concatenate([matrices[:, :3, 3], tails])
        metres_per_armature_unit = metres_per_unit(armature_object)
        size = metres_per_armature_unit * float(np.ptp(bone_ends, axis=0).max())
        tolerance = max(MIN_DISTANCE_TOLERANCE, RELATIVE_DISTANCE_TOLERANCE * size)
        distances = metres_per_armature_unit * np.maximum(
            np.linalg.norm(mirror_images[:, :3, 3] - matrices[:, :3, 3], axis=1),
            np.linalg.norm(tails[partner_indices] * [-1, 1, 1] - tails, axis=1),
        )
        axis_distances = np.linalg.norm(mirror_images[:, :3, :3] - matrices[:, :3, :3], axis=1).max(axis=1)
        for index, bone in enumerate(bones):
            partner = bones[int(partner_indices[index])]
            if distances[index] > tolerance:
                difference = f"by {distances[index] * 1000:.1f} mm"
            elif axis_distances[index] > AXIS_TOLERANCE:
                angle = np.degrees(2 * np.arcsin(min(1.0, axis_distances[index] / 2)))
                difference = f"in roll or direction, by {angle:.1f}°"
            elif (
                armature_object.pose.bones[bone.name].rotation_mode
                != armature_object.pose.bones[partner.name].rotation_mode
            ):
                difference = "in rotation mode"
            else:
                continue
            name, expected_partner_name = bone.name, flipped_name(bone.name)
            if partner != bone:
                problem = f"the bones '{name}' and '{partner.name}' differ {difference}; symmetrize the armature"
            elif expected_partner_name != name:
                problem = f"there is no bone '{expected_partner_name}' for '{name}'; add it"
            else:
                problem = f"the bone '{name}' differs from its mirror image {difference}; bring it into the middle"
            raise RigError(f"'{armature_object.name}' cannot be mirrored: {problem}, or leave mirroring out.")
        escape = bpy.utils.escape_identifier
        paths = {
            (armature_object, f'{bone.path_from_id()}["{escape(key)}"]')
            for bone in armature_object.pose.bones
            for key in bone.keys()  # noqa: SIM118
        }
        self._partner_paths: dict[tuple[bpy.types.ID, str], str] = {}
        for datablock, path in {*paths, *animated_numbers}:
            flipped_path = _flipped_path(path)
            if flipped_path != path and _is_number(datablock, path) and _is_number(datablock, flipped_path):
                self._partner_paths |= {(datablock, path): flipped_path, (datablock, flipped_path): path}

    @property
    def numbers(self) -> list[tuple[bpy.types.ID, str]]:
        """Return the datablocks and RNA paths of the numbers that are exchanged."""
        return list(self._partner_paths)

    def apply(self) -> None:
        """Mirror the current pose and numbers without evaluating them."""
        bones = self._armature_object.pose.bones
        for channel in POSE_CHANNELS:
            write(bones, channel, read(bones, channel)[self._partner_indices] * np.float32(_MIRROR_SIGNS[channel.name]))
        values = {number: number[0].path_resolve(partner) for number, partner in self._partner_paths.items()}
        for (datablock, path), value in values.items():
            set_value(datablock, path, value)
        for datablock in {datablock for datablock, _ in values} | {self._armature_object}:
            # Custom properties do not tag their datablock.
            datablock.update_tag()


def _flipped_path(path: str) -> str:
    def flip(match: re.Match) -> str:
        return f'["{bpy.utils.escape_identifier(flipped_name(bpy.utils.unescape_identifier(match[1])))}"]'

    return _QUOTED_NAME.sub(flip, path)


def _is_number(datablock: bpy.types.ID, path: str) -> bool:
    try:
        return isinstance(datablock.path_resolve(path), int | float)
    except ValueError:
        return False
