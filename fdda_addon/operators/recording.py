# SPDX-License-Identifier: GPL-3.0-or-later
"""The recording: evaluate the poses of a character and keep them in a folder."""

from collections.abc import Iterator
from pathlib import Path

import bpy

from ..core.errors import FDDAError
from ..settings import model_file, recording_folder
from .job import JobOperator, current
from .on_rig import OnRig
from .sampling import recording_settings


class FDDA_OT_record(OnRig, JobOperator, bpy.types.Operator):
    bl_idname = "fdda.record"
    bl_label = "Record"
    bl_description = "Let Blender evaluate random poses and the chosen actions, and keep them in the folder"
    bl_options = {"REGISTER"}
    verb, title = "record", "Recording"

    folder: bpy.props.StringProperty(
        name="Folder",
        description="Folder of the recording; empty for that of the character",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )
    resume: bpy.props.BoolProperty(
        name="Resume", description="Continue a recording that was broken off", options={"SKIP_SAVE"}
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        if properties.resume:
            return "Continue the recording in the folder where it stopped"
        return cls.bl_description

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return cls.is_idle() and cls.has_rig(context)

    def steps(self, context: bpy.types.Context) -> Iterator[object]:
        from ..recording import record
        from ..runtime.binding import true_rig

        rig = self.rig(context)
        self._path = Path(bpy.path.abspath(self.folder)) if self.folder else recording_folder(rig.mesh_object)
        with true_rig(rig.mesh_object):
            yield from record(rig, self._path, recording_settings(rig, self.resume))

    def finish(self, _context: bpy.types.Context, _result: object) -> str:
        return f"Recorded {self.state.total:,} poses into '{self._path.name}'."

    def cancelled(self, _context: bpy.types.Context) -> str:
        if self.state.stage != "poses" or not self.state.done:
            return "Recording cancelled before the first pose; nothing was kept."
        return f"Recording cancelled; {self.state.done:,} of {self.state.total:,} poses are kept, resume goes on there."


class FDDA_OT_refine(OnRig, JobOperator, bpy.types.Operator):
    bl_idname = "fdda.refine"
    bl_label = "Add Poses Where It Is Worst"
    bl_description = "Compare the trained model with the rig, and add poses to the recording where it errs most"
    bl_options = {"REGISTER"}
    verb, title = "refine", "Refinement"

    poses: bpy.props.IntProperty(
        name="Poses", description="How many poses are added", default=250, min=1, options={"SKIP_SAVE"}
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return cls.is_idle() and cls.has_rig(context)

    def steps(self, context: bpy.types.Context) -> Iterator[object]:
        from ..refinement import RefinementSettings, refine
        from ..runtime.binding import true_rig

        rig = self.rig(context)
        self._path, model = recording_folder(rig.mesh_object), model_file(rig.mesh_object)
        wanted = RefinementSettings(self.poses, rig.mesh_object.fdda.settings.seed)
        with true_rig(rig.mesh_object):
            yield from refine(rig, self._path, model, wanted)

    def finish(self, _context: bpy.types.Context, _result: object) -> str:
        return f"Added {self.state.total:,} poses to '{self._path.name}'; train on with them."

    def cancelled(self, _context: bpy.types.Context) -> str:
        added = self.state.done if self.state.stage == "poses" else 0
        return f"Refinement cancelled; {added:,} poses were added."


class FDDA_OT_remove_recording(OnRig, bpy.types.Operator):
    bl_idname = "fdda.remove_recording"
    bl_label = "Remove Recording"
    bl_description = (
        "Remove the recording that is in the folder, so that another can be made there. This cannot be undone"
    )
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if (job := current()) is not None:
            cls.poll_message_set(f"{job.title} is under way; wait for it or cancel it")
            return False
        return cls.has_rig(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if bpy.app.background or context.window is None:
            return self.execute(context)
        return context.window_manager.invoke_confirm(self, event)

    def execute(self, context: bpy.types.Context) -> set[str]:
        from ..core.recording_folder import remove_recording

        try:
            path = recording_folder(self.rig(context).mesh_object)
            remove_recording(path)
        except FDDAError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Removed the recording '{path.name}'.")
        return {"FINISHED"}


CLASSES = (FDDA_OT_record, FDDA_OT_refine, FDDA_OT_remove_recording)
