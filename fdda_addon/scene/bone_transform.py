# SPDX-License-Identifier: GPL-3.0-or-later
"""Recognizes the controls that are numbers of a bone's transform, by their RNA paths."""

import re
from collections.abc import Iterable
from dataclasses import dataclass

import bpy

from ..core.controls import ARMATURE_OBJECT, Control

_BONE_TRANSFORM_PATH = re.compile(
    r'(?P<bone>pose\.bones\["(?P<name>(?:[^"\\]|\\.)*)"\])\.'
    r"(?P<property>location|scale|rotation_\w+|matrix_basis)\[(?P<index>\d)\](?:\[(?P<row>[0-3])\])?"
)
MATRIX = "matrix_basis"
"""RNA property of a pose bone: the 4x4 transform that its channels define, relative to its rest pose, without its
constraints. `matrix_basis[C][R]` is the element in column C and row R. A control on it can be read but not set."""
MATRIX_ELEMENT_RANGE = (-1.0, 1.0)
"""Range of an element of a rotation matrix."""


@dataclass(frozen=True)
class BoneTransform:
    """The number of a bone's transform that a control is.

    Attributes:
        bone_path: RNA path of the pose bone in its armature object.
        bone_name: name of the bone.
        element: column and row of the number in `MATRIX`; None for a scale or a rotation channel.
        is_matrix: the path of the control is an element of `MATRIX`.
        scale_axis: axis of a scale; None for any other number.
    """

    bone_path: str
    bone_name: str
    element: tuple[int, int] | None
    is_matrix: bool
    scale_axis: int | None


def bone_transform(path: str) -> BoneTransform | None:
    """Return the number of a bone's transform at the path of a control; None for any other number."""
    match = _BONE_TRANSFORM_PATH.fullmatch(path)
    is_matrix = match is not None and match["property"] == MATRIX
    if match is None or is_matrix != (match["row"] is not None):
        return None
    element = (int(match["index"]), int(match["row"])) if is_matrix else None
    if match["property"] == "location":
        element = 3, int(match["index"])
    scale_axis = int(match["index"]) if match["property"] == "scale" else None
    return BoneTransform(match["bone"], bpy.utils.unescape_identifier(match["name"]), element, is_matrix, scale_axis)


def controls_by_bone(controls: Iterable[Control]) -> dict[str, tuple[int, ...]]:
    """Return the indices of the controls that are numbers of a bone's transform, by the name of the bone.

    Bones of other armatures are left out.
    """
    indices: dict[str, list[int]] = {}
    for index, control in enumerate(controls):
        transform = bone_transform(control.path) if control.owner == ARMATURE_OBJECT else None
        if transform is not None:
            indices.setdefault(transform.bone_name, []).append(index)
    return {name: tuple(bone_indices) for name, bone_indices in indices.items()}
