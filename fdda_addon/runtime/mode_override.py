# SPDX-License-Identifier: GPL-3.0-or-later
"""Overrides the mode of bound objects temporarily, also if their own mode is keyed, driven or changed."""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

_mode_stacks: dict[int, list[str]] = {}
"""Stacks of overriding modes, by the session ids of the objects. The last mode of a stack is in effect."""


@contextmanager
def override_mode(mesh_object: bpy.types.Object, mode: str) -> Iterator[None]:
    """Override the mode of a bound object: no handler, driver, keyframe or user switches its modifiers meanwhile."""
    object_uid = mesh_object.session_uid
    _mode_stacks.setdefault(object_uid, []).append(mode)
    try:
        yield
    finally:
        _mode_stacks[object_uid].pop()
        if not _mode_stacks[object_uid]:
            del _mode_stacks[object_uid]


def overriding_mode(object_uid: int) -> str:
    """Return the mode that overrides the mode of an object, given by its session id; empty if there is none."""
    mode_stack = _mode_stacks.get(object_uid)
    return mode_stack[-1] if mode_stack else ""


def uses_model(mesh_object: bpy.types.Object) -> bool:
    """Return whether a bound object shows its model, according to its overriding mode or else its own mode."""
    return (overriding_mode(mesh_object.session_uid) or mesh_object.fdda.mode) != "RIG"
