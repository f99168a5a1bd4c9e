# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on, registered for as long as a verb works in Blender."""

from collections.abc import Iterator
from contextlib import contextmanager

from .. import registration
from .interruption import interruptible


@contextmanager
def registered() -> Iterator[None]:
    """Inside, the add-on is registered and Ctrl-C ends the work; it stays registered where Blender had enabled it."""
    was_registered = registration.is_registered()
    registration.register()
    try:
        with interruptible():
            yield
    finally:
        if not was_registered:
            registration.unregister()
