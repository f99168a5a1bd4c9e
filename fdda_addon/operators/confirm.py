# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs that first show a file browser or a dialog.

Blender calls `execute` after the dialog, where a job would run to its end at once. So it invokes the operator again.
"""

import bpy

from .job import JobOperator


class ConfirmFirst(JobOperator):
    """Mixin for a job operator with a dialog. Its `invoke` shows it and sets `_is_confirming`."""

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
