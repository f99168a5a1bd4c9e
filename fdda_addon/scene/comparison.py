# SPDX-License-Identifier: GPL-3.0-or-later
"""Copies of characters that stand beside them to be compared with: how they are told from characters."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import bpy

COMPARISON_KEY = "fdda_compared"
"""Custom property of a copy: the mesh object that it is compared with."""


def is_comparison(scene_object: bpy.types.Object) -> bool:
    """Whether an object is such a copy, and no character of the user's."""
    return scene_object.is_runtime_data and COMPARISON_KEY in scene_object


def comparisons() -> list[bpy.types.Object]:
    """All such copies in the open file."""
    return [o for o in bpy.data.objects if is_comparison(o)]


@contextmanager
def hidden_comparisons() -> Iterator[None]:
    """Spare Blender their evaluation for a while."""
    from .temporary_state import temporary_attributes  # Blender starts without numpy.

    with ExitStack() as stack:
        for other in comparisons():
            stack.enter_context(temporary_attributes(other, hide_viewport=True))
        yield
