# SPDX-License-Identifier: GPL-3.0-or-later
"""Overrides the mode of bound objects for a while, whatever sets their own mode."""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

_modes: dict[int, list[str]] = {}
"""Stacks of overriding modes by the session ids of the objects; the last mode counts."""


@contextmanager
def override_mode(mesh_object: bpy.types.Object, mode: str) -> Iterator[None]:
    """Override the mode of a bound object: no handler, driver, keyframe or user switches its modifiers meanwhile."""
    uid = mesh_object.session_uid
    _modes.setdefault(uid, []).append(mode)
    try:
        yield
    finally:
        _modes[uid].pop()
        if not _modes[uid]:
            del _modes[uid]


def overridden_mode(uid: int) -> str:
    """Return the mode that overrides that of an object, given by its session id; empty for none."""
    modes = _modes.get(uid)
    return modes[-1] if modes else ""


def uses_model(mesh_object: bpy.types.Object) -> bool:
    """Return whether the mode of a bound object, or the one that overrides it, shows its model."""
    return (overridden_mode(mesh_object.session_uid) or mesh_object.fdda.mode) != "RIG"
