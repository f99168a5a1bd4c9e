# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that record poses, add poses at the worst errors, and delete a recording."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import bpy

from ..core.errors import FDDAError
from ..core.recording.estimate import format_poses
from ..core.recording.folder import remove_recording
from ..core.recording.index import read_index, read_info
from ..core.settings import REFINEMENT_POSES
from ..core.wording import format_count
from ..jobs.state import JobStep
from ..models.model_list import format_file_size
from ..properties.character import model_file, recording_folder
from ..properties.recording_options import copy_settings, recording_settings
from ..recording.plan import find_recorded_character
from ..recording.refinement import RefinementSettings, refine
from ..recording.rig_check import problems_beside_others
from ..recording.run import record
from ..runtime.binding import model_disabled
from ..scene.scene_rig import SceneRig, describe_left_out, join_rigs, left_out_reason
from .job import JobOperator
from .rig_operator import RigOperator


def recordable_character(rigs: list[SceneRig], shown: SceneRig) -> tuple[SceneRig, str]:
    """Join the rigs that can be recorded.

    Args:
        shown: the rig that the sidebar shows, which stays in: its problems end the recording.

    Returns:
        The joined rig, and a sentence about the meshes that are left out; empty for none.
    """
    reasons, problems, settings = {}, [], recording_settings(shown)
    for rig in [rig for rig in rigs if rig != shown]:
        if reason := left_out_reason(rig.mesh_object):
            reasons[rig.mesh_object] = reason
            continue
        with model_disabled(rig.mesh_object):
            if found := problems_beside_others(rig, settings):
                problems.append(f"Left out '{rig.mesh_object.name}': {found[0]}")
                reasons[rig.mesh_object] = ""
    text = describe_left_out({o: reason for o, reason in reasons.items() if reason})
    character = join_rigs([rig for rig in rigs if rig.mesh_object not in reasons])
    return character, " ".join(filter(None, [text, *problems]))


def record_character(
    character: SceneRig, shown_object: bpy.types.Object, path: Path, resume: bool = False
) -> Iterator[object]:
    """Record the meshes of a character with the settings of the mesh that the sidebar shows, which the others get."""
    with ExitStack() as stack:
        for mesh_object in character.mesh_objects:
            stack.enter_context(model_disabled(mesh_object))
            if mesh_object != shown_object:
                copy_settings(mesh_object, shown_object)
        yield from record(character, path, recording_settings(character, resume))


def recording_steps(rig: SceneRig) -> list[JobStep]:
    """Return the steps of a recording with the settings of a rig."""
    check = [("checking the object", ("target",))] if rig.mesh_object.fdda.settings.learn_from else []
    return [*check, ("recording", ("poses", "influences", "repeatability"))]


class FDDA_OT_record(JobOperator, bpy.types.Operator):
    bl_idname = "fdda.record"
    bl_label = "Record"
    bl_description = "Evaluate random poses and the checked actions, and write the deformed mesh to the folder"
    verb, title = "record", "Recording"

    folder: bpy.props.StringProperty(
        name="Folder",
        description="Folder of the recording. Empty for the folder in the settings of the mesh",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )
    resume: bpy.props.BoolProperty(
        name="Resume", description="Continue an interrupted recording", options={"SKIP_SAVE"}
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        if properties.resume:
            return "Continue the recording in the folder where it stopped"
        return cls.bl_description

    def steps(self, context: bpy.types.Context) -> Iterator[object]:
        shown = self.rig(context)
        character, self._note = recordable_character(self.rigs(context), shown)
        self.state.steps = recording_steps(shown)
        # The other meshes get the settings of the shown one.
        self.changes_file = len(character.mesh_objects) > 1
        folder = self.folder and Path(bpy.path.abspath(self.folder))
        self._path = folder or recording_folder(shown.mesh_object)
        yield from record_character(character, shown.mesh_object, self._path, self.resume)

    def finish(self, _context: bpy.types.Context, _result: object) -> str:
        info = read_info(read_index(self._path))
        poses_text = format_poses(info.poses, len(info.alone_poses))
        return f"Recorded {poses_text}, into '{self._path.name}'. {self._note}".rstrip()

    def cancel_message(self, _context: bpy.types.Context) -> str:
        if self.state.stage not in ("poses", "influences", "repeatability") or not self.state.done:
            return "Recording canceled before the first pose; nothing was kept."
        kept_text = f"{self.state.done:,} of {self.state.total:,}" if self.state.stage == "poses" else "All"
        return f"Recording canceled. {kept_text} poses are kept; press Resume to continue."


class FDDA_OT_refine(JobOperator, bpy.types.Operator):
    bl_idname = "fdda.refine"
    bl_label = "Add Poses at Worst Errors"
    bl_description = "Compare the trained model with the rig, and record more poses where its error is largest"
    verb, title = "refine", "Refinement"

    poses: bpy.props.IntProperty(
        name="Poses", description="Number of poses to add", default=REFINEMENT_POSES, min=1, options={"SKIP_SAVE"}
    )

    def steps(self, context: bpy.types.Context) -> Iterator[object]:
        rig = self.rig(context)
        self._path, model = recording_folder(rig.mesh_object), model_file(rig.mesh_object)
        settings = RefinementSettings(self.poses, rig.mesh_object.fdda.settings.seed)
        character = find_recorded_character(self._path, rig.mesh_object.name)
        with ExitStack() as stack:
            for mesh_object in character.mesh_objects:
                stack.enter_context(model_disabled(mesh_object))
            yield from refine(character, self._path, model, settings)

    def finish(self, _context: bpy.types.Context, _result: object) -> str:
        return f"Added {format_count(self.state.total, 'pose')} to '{self._path.name}'; press Continue Training."

    def cancel_message(self, _context: bpy.types.Context) -> str:
        added = self.state.done if self.state.stage == "poses" else 0
        return f"Refinement canceled after {format_count(added, 'added pose')}."


class FDDA_OT_delete_recording(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.delete_recording"
    bl_label = "Delete Recording"
    bl_description = "Delete the recording in the folder. This cannot be undone"
    bl_options = {"REGISTER"}
    waits_for_all_jobs = True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if bpy.app.background or context.window is None:
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self,
            event,
            title="Delete Recording?",
            message=self._deletion_message(context),
            confirm_text="Delete",
            icon="WARNING",
        )

    def _deletion_message(self, context: bpy.types.Context) -> str:
        """Return a message about what would be deleted."""
        try:
            path = recording_folder(self.rig(context).mesh_object)
            count = read_index(path)["complete"]
        except FDDAError as error:
            return str(error)
        size = sum(file.stat().st_size for file in path.glob("*.npy"))
        size_text = f"{format_count(count, 'pose')}, {format_file_size(size)}"
        return f"{size_text}, in '{path}'. This cannot be undone. Models are kept."

    def apply(self, context: bpy.types.Context) -> str:
        path = recording_folder(self.rig(context).mesh_object)
        remove_recording(path)
        return f"Deleted the recording '{path.name}'."


CLASSES = (FDDA_OT_record, FDDA_OT_refine, FDDA_OT_delete_recording)
