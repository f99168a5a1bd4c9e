# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on, registered for as long as a verb works in Blender."""

from collections.abc import Iterator
from contextlib import contextmanager

from .. import registration
from .interruption import note_callbacks, raise_pending


@contextmanager
def registered() -> Iterator[None]:
    """Inside, the add-on is registered; it stays registered where Blender had enabled it."""
    was_registered = registration.is_registered()
    registration.register()
    note_callbacks(handler.__module__ for _, handler in registration.handler_table())
    try:
        raise_pending()
        yield
    finally:
        if not was_registered:
            registration.unregister()
