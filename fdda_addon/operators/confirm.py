# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs that ask before they begin, with a file browser or a dialog.

Blender executes an operator when its question is answered, and an operator that is executed works to its end at once:
the answer therefore invokes the operator a second time.
"""

import bpy

from .job import JobOperator


class ConfirmFirst(JobOperator):
    """Mixin for an operator of a job that may ask first; `invoke` does, with `_is_confirming` set."""

    _is_confirming = False

    def confirmed_properties(self) -> dict[str, object]:
        """The properties that it is invoked with once the question was answered."""
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
