# SPDX-License-Identifier: GPL-3.0-or-later
"""Base class of operators that show a file browser or a dialog before their job.

After the dialog Blender calls `execute`, which would block Blender until the job ends. So `execute` invokes the
operator a second time.
"""

import bpy

from ..core.errors import FDDAError
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


class ChooseFileFirst(ConfirmFirst):
    """Mixin for a job operator that writes the file `filepath`, and shows a file browser if that is empty."""

    filepath: str
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN"})

    def suggested_path(self, context: bpy.types.Context) -> str:
        """Return the file that the browser suggests; `//` stands for the folder of the .blend file.

        Raises:
            FDDAError: the operator cannot run; there is nothing to choose.
        """
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.filepath:
            return ConfirmFirst.invoke(self, context, event)
        try:
            self.filepath = bpy.path.abspath(self.suggested_path(context))
        except FDDAError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self._is_confirming = True
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}
