# SPDX-License-Identifier: GPL-3.0-or-later
"""Identifies comparison objects: copies of a character's mesh object that show the rig beside or over it."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import bpy

from .temporary_state import temporary_attributes

COMPARISON_KEY = "fdda_compared"
"""Custom property of a comparison object that refers to the mesh object with which it is compared."""


def is_comparison(scene_object: bpy.types.Object) -> bool:
    """Return whether an object is a comparison object."""
    return scene_object.is_runtime_data and COMPARISON_KEY in scene_object


def comparison_objects() -> list[bpy.types.Object]:
    """Return all comparison objects of the open file."""
    return [o for o in bpy.data.objects if is_comparison(o)]


@contextmanager
def hidden_comparison_objects() -> Iterator[None]:
    """Hide all comparison objects, so that Blender does not evaluate them."""
    with ExitStack() as stack:
        for comparison_object in comparison_objects():
            stack.enter_context(temporary_attributes(comparison_object, hide_viewport=True))
        yield
