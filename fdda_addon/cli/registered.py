# SPDX-License-Identifier: GPL-3.0-or-later
"""Registers the add-on while a verb runs in Blender."""

from collections.abc import Iterator
from contextlib import contextmanager

from .. import registration
from .interruption import raise_pending


@contextmanager
def registered() -> Iterator[None]:
    """Register the add-on for a `with` block. It stays registered if it was before."""
    was_registered = registration.is_registered()
    registration.register()
    try:
        raise_pending()
        yield
    finally:
        if not was_registered:
            registration.unregister()
