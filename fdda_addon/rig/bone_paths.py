# SPDX-License-Identifier: GPL-3.0-or-later
"""Splits data paths of armature objects into a bone and a path in the bone."""

import re

import bpy

from ..scene.controls import canonical_path

_BONE_PATH = re.compile(r'pose\.bones\["(?P<bone>(?:[^"\\]|\\.)*)"\]')
_TRANSFORM_CHANNEL = re.compile(r"\.(?:location|rotation_\w+|scale)(?:\[\d\])?")


def split_bone_path(datablock: bpy.types.ID, path: str) -> tuple[str, str]:
    """Split a path of a datablock into the name of a bone, empty for other paths, and the path in the bone."""
    path = canonical_path(datablock, path)
    match = _BONE_PATH.match(path)
    return (bpy.utils.unescape_identifier(match["bone"]), path[match.end() :]) if match else ("", path)


def is_transform_channel(subpath: str) -> bool:
    """Return whether a path relative to a bone is a location, a rotation or a scale."""
    return _TRANSFORM_CHANNEL.fullmatch(subpath) is not None
