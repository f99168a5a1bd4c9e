# SPDX-License-Identifier: GPL-3.0-or-later
"""Base class of operators that change the pose, the limits or the recorded inputs of a rig."""

from contextlib import suppress

import bpy

from ..core.errors import FDDAError
from ..jobs.job import current
from ..properties.recording_options import recording_settings
from ..recording.preview import show_random_pose, shows_random_pose
from .rig_operator import RigOperator


class PoseOperator(RigOperator):
    """Mixin for an operator in Object Mode or Pose Mode that changes a rig."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        job = current()
        if job is not None and job.changes_scene:
            cls.poll_message_set(f"{job.title} is under way; wait for it or cancel it")
            return False
        if context.mode not in {"OBJECT", "POSE"}:
            cls.poll_message_set("Only available in Object Mode and Pose Mode")
            return False
        return cls.has_rig(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            message = self.apply(context)
        except FDDAError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, message)
        return {"FINISHED"}


class LimitsOperator(PoseOperator):
    """Mixin for an operator that changes limits. A random pose that the rig shows is then posed within the new ones."""

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            rig = self.rig(context)
            is_preview = shows_random_pose(rig)
        except FDDAError:
            is_preview = False
        result = super().execute(context)
        if is_preview and result == {"FINISHED"}:
            # If all axes are locked now, there is no random pose.
            with suppress(FDDAError):
                show_random_pose(rig, recording_settings(rig), context.window_manager.fdda.pose_index)
        return result
