# SPDX-License-Identifier: GPL-3.0-or-later
"""Base class of operators that show a file browser or a dialog before their job.

After the dialog Blender calls `execute`, which would block Blender until the job ends. So `execute` invokes the
operator a second time.
"""

import bpy

from .job import JobOperator


class ConfirmFirst(JobOperator):
    """Mixin for a job operator whose `invoke` shows a dialog and sets `_is_confirming`."""

    _is_confirming = False

    def confirmed_properties(self) -> dict[str, object]:
        """Return the properties for the second invocation."""
        return {}

    def execute(self, context: bpy.types.Context) -> set[str]:
        if self._is_confirming:
            return getattr(bpy.ops.fdda, self.bl_idname.lower().rpartition("_ot_")[2])(
                "INVOKE_DEFAULT", **self.confirmed_properties()
            )
        return JobOperator.execute(self, context)

    def cancel(self, context: bpy.types.Context) -> None:
        if not self._is_confirming:
            JobOperator.cancel(self, context)
