# SPDX-License-Identifier: GPL-3.0-or-later
"""Values that a timer works out while a panel shows them: drawing itself neither computes nor reads files."""

from collections.abc import Callable

import bpy

from ..jobs.job import current, redraw

SECOND_DRAWING = 0.1


class Watch:
    """A value about mesh objects.

    Every look of a panel has the value worked out once more, shortly after. When it has changed the panel is drawn
    again, and so looks again; when nobody looks nothing is worked out.
    """

    def __init__(self, work: Callable[[bpy.types.Object], object], seconds: float):
        """Args:
        work: works the value out. It is called outside of drawing, and not while a job borrows the scene.
        seconds: from a look to the work; so often at most while something changes all the time.
        """
        self._work, self._seconds = work, seconds
        self._values: dict[int, object] = {}
        self._wanted: set[int] = set()
        self._timer = self._tick

    def look(self, mesh_object: bpy.types.Object) -> object | None:
        """The value as it was worked out last, None when it never was. For `draw`."""
        self._wanted.add(mesh_object.session_uid)
        if not bpy.app.background and not bpy.app.timers.is_registered(self._timer):
            known = mesh_object.session_uid in self._values
            bpy.app.timers.register(self._timer, first_interval=self._seconds if known else 0.0)
        return self._values.get(mesh_object.session_uid)

    def now(self, mesh_object: bpy.types.Object) -> object:
        """Work the value out at once."""
        value = self._values[mesh_object.session_uid] = self._work(mesh_object)
        return value

    def stop(self) -> None:
        """Forget all values."""
        if bpy.app.timers.is_registered(self._timer):
            bpy.app.timers.unregister(self._timer)
        self._values.clear()
        self._wanted.clear()

    def _tick(self) -> None:
        job = current()
        if job is not None and job.borrows_scene:
            return
        objects = {o.session_uid: o for o in bpy.data.objects if o.session_uid in self._wanted}
        before = dict(self._values)
        self._values = {uid: value for uid, value in self._values.items() if uid in objects}
        self._wanted.clear()
        for mesh_object in objects.values():
            self.now(mesh_object)
        if self._values != before:
            redraw()
            # A panel of another height than before finds its place at the second drawing.
            bpy.app.timers.register(redraw, first_interval=SECOND_DRAWING)
