# SPDX-License-Identifier: GPL-3.0-or-later
"""Values for panels, computed by a timer, because drawing should neither compute nor read files."""

import time
from collections.abc import Callable

import bpy

from ..jobs.job import current, redraw

SECOND_REDRAW_SECONDS = 0.1


Compute = Callable[[bpy.types.Object], object]


class TimedValues:
    """Values of mesh objects, by the function that computes them and the session id of the mesh object.

    Each `get` schedules one computation. A changed value redraws the panel, which calls `get` again. Nothing is
    computed while no panel shows a value. Values of removed objects are dropped by the timer, all others by `stop`.
    """

    def __init__(self) -> None:
        self._values: dict[tuple[Compute, int], object] = {}
        self._requested: dict[tuple[Compute, int], float] = {}
        # One object for all calls: Blender compares timers by identity.
        self._timer = self.tick

    def get(self, compute: Compute, mesh_object: bpy.types.Object, seconds: float) -> object | None:
        """Return the last value, None before the first, and schedule a computation. For `draw`.

        Args:
            compute: returns the value. It is called outside of drawing, and not while a job changes the scene.
            seconds: time between a `get` and the computation, and so the shortest time between two computations.
        """
        key, now = (compute, mesh_object.session_uid), time.monotonic()
        if key not in self._requested:
            self._requested[key] = now + (seconds if key in self._values else 0.0)
            if not bpy.app.background:
                self._remove_timer()
                bpy.app.timers.register(self._timer, first_interval=max(min(self._requested.values()) - now, 0.0))
        return self._values.get(key)

    def last(self, compute: Compute, mesh_object: bpy.types.Object) -> object | None:
        """Return the last value, None before the first."""
        return self._values.get((compute, mesh_object.session_uid))

    def compute_now(self, compute: Compute, mesh_object: bpy.types.Object) -> object:
        """Compute a value and return it."""
        value = self._values[compute, mesh_object.session_uid] = compute(mesh_object)
        return value

    def stop(self) -> None:
        """Remove the timer and all values."""
        self._remove_timer()
        self._values.clear()
        self._requested.clear()

    def _remove_timer(self) -> None:
        if bpy.app.timers.is_registered(self._timer):
            bpy.app.timers.unregister(self._timer)

    def tick(self) -> float | None:
        """Compute the values that are due; return the seconds until the next one is due, None without one."""
        job = current()
        if job is not None and job.changes_scene:
            self._requested.clear()
            return None
        objects = {o.session_uid: o for o in bpy.data.objects if o.type == "MESH"}
        previous_values, now = dict(self._values), time.monotonic()
        self._values = {key: value for key, value in self._values.items() if key[1] in objects}
        for key in [key for key, due in self._requested.items() if due <= now]:
            del self._requested[key]
            compute, uid = key
            if uid in objects:
                self.compute_now(compute, objects[uid])
        if self._values != previous_values:
            redraw()
            # Blender places a panel whose height has changed correctly only in the second redraw.
            bpy.app.timers.register(redraw, first_interval=SECOND_REDRAW_SECONDS)
        return max(min(self._requested.values()) - now, 0.0) if self._requested else None


timed_values = TimedValues()
