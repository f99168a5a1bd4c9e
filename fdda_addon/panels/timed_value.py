# SPDX-License-Identifier: GPL-3.0-or-later
"""Values for panels, computed by a timer, because drawing should neither compute nor read files."""

from collections.abc import Callable

import bpy

from ..jobs.job import current, redraw

SECOND_REDRAW_SECONDS = 0.1


class TimedValue:
    """A value for each mesh object, computed by a timer.

    Each `get` schedules one computation. A changed value redraws the panel, which calls `get` again. Nothing is
    computed while no panel shows the value.
    """

    def __init__(self, compute: Callable[[bpy.types.Object], object], seconds: float):
        """Args:
        compute: returns the value. It is called outside of drawing, and not while a job changes the scene.
        seconds: time between a `get` and the computation, and so the shortest time between two computations.
        """
        self._compute, self._seconds = compute, seconds
        self._values: dict[int, object] = {}
        self._requested: set[int] = set()
        # One object for all calls: Blender compares timers by identity.
        self._timer = self._tick

    def get(self, mesh_object: bpy.types.Object) -> object | None:
        """Return the last value, None before the first, and schedule a computation. For `draw`."""
        uid = mesh_object.session_uid
        self._requested.add(uid)
        if not bpy.app.background and not bpy.app.timers.is_registered(self._timer):
            bpy.app.timers.register(self._timer, first_interval=self._seconds if uid in self._values else 0.0)
        return self._values.get(uid)

    def compute_now(self, mesh_object: bpy.types.Object) -> object:
        """Compute the value and return it."""
        value = self._values[mesh_object.session_uid] = self._compute(mesh_object)
        return value

    def stop(self) -> None:
        """Remove the timer and all values."""
        if bpy.app.timers.is_registered(self._timer):
            bpy.app.timers.unregister(self._timer)
        self._values.clear()
        self._requested.clear()

    def _tick(self) -> None:
        job = current()
        if job is not None and job.changes_scene:
            return
        objects = {o.session_uid: o for o in bpy.data.objects if o.session_uid in self._requested}
        previous_values = dict(self._values)
        self._values = {uid: value for uid, value in self._values.items() if uid in objects}
        self._requested.clear()
        for mesh_object in objects.values():
            self.compute_now(mesh_object)
        if self._values != previous_values:
            redraw()
            # Blender places a panel whose height has changed correctly only in the second redraw.
            bpy.app.timers.register(redraw, first_interval=SECOND_REDRAW_SECONDS)
