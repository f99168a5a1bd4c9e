# SPDX-License-Identifier: GPL-3.0-or-later
"""Section "Recording": shows the settings, the content of the folder, and the button to record."""

import json
import os
from dataclasses import replace
from pathlib import Path

import bpy

from ..core.errors import FDDAError, RecordingError, RigError
from ..core.recording.estimate import format_poses
from ..core.recording.folder import FolderContent, FolderState, read_folder
from ..core.recording.index import INDEX_NAME
from ..core.settings import MAX_AUTO_POSES, POSES
from ..core.wording import format_count
from ..jobs import job
from ..operators.training import is_mesh_recorded
from ..poses.action_range import action_frames
from ..properties.character import default_recording, recording_folder
from ..properties.recording_options import recorded_actions, recording_settings
from ..recording.plan import (
    find_recorded_character,
    keep_recorded_poses,
    make_sampling,
    read_sampled_rig,
)
from ..scene.draw_cache import computed_once, draw_cached
from ..scene.scene_rig import SceneRig
from . import checks
from .meshes import draw_meshes
from .section import Section, draw_advanced, draw_button, draw_job, draw_path, draw_wrapped, is_recordable, panel_rig


@draw_cached
def read_content(rig: SceneRig) -> "tuple[Path, FolderContent] | str":
    """Return the recording folder of a character and its content, or an error message."""
    try:
        path = recording_folder(rig.mesh_object)
        return path, cached_content(rig, path)
    except FDDAError as error:
        return str(error)


def has_recording(rig: SceneRig) -> bool:
    """Return whether the recording folder of a character has its complete recording."""
    content = read_content(rig)
    return not isinstance(content, str) and content[1].state is FolderState.COMPLETE


def is_in_recording(rig: SceneRig, shown: SceneRig) -> bool:
    """Return whether the recording of a shown rig, which is complete, has the mesh of another that is not left out."""
    path, check = recording_folder(shown.mesh_object), checks.last_check(rig)
    inputs = path, _modified_ns(path), rig.mesh_object.name, check and check.rig
    name = ("mesh in a recording", rig.mesh_object.session_uid)
    return is_recordable(rig) and computed_once(name, inputs, lambda: is_mesh_recorded(rig.mesh_object, path))


def _modified_ns(path: Path) -> int:
    """Return when the index of a recording was written; -1 for a folder without one, 0 for none."""
    try:
        return os.stat(path / INDEX_NAME).st_mtime_ns
    except OSError:
        return -1 if path.exists() else 0


def cached_content(rig: SceneRig, path: Path) -> "FolderContent":
    """Return the content of a recording folder. Read it again after a change of the folder, the rig or the settings."""
    check, settings = checks.last_check(rig), recording_settings(rig)

    def read() -> "FolderContent":
        if check is None or check.rig is None:
            return read_folder(path)
        try:
            character = find_recorded_character(path, rig.mesh_object.name)
            planned = keep_recorded_poses(settings, path)
            recorded_rig, channels = check.rig, check.channels
            if character.other_meshes:
                recorded_rig, channels = read_sampled_rig(character, planned)
        except RecordingError:
            character, planned, recorded_rig, channels = rig, settings, check.rig, check.channels
        except RigError as error:
            return replace(read_folder(path), state=FolderState.OTHER, sentence=str(error))
        # Converted to JSON and back, so that it equals the one of a recording.
        sampling = json.loads(json.dumps(make_sampling(character, planned, channels).to_json()))
        return read_folder(path, recorded_rig, sampling)

    name = ("recording folder", rig.mesh_object.session_uid)
    return computed_once(name, (path, _modified_ns(path), check, settings), read)


class FDDA_PT_recording(Section, bpy.types.Panel):
    bl_idname = "FDDA_PT_recording"
    bl_label = "Recording"
    bl_options = {"DEFAULT_CLOSED"}
    verbs = ("record", "export_skinning")

    @classmethod
    def is_done(cls, context: bpy.types.Context) -> bool:
        rig = panel_rig(context)[0]
        running_job = job.current()
        if rig is None or (running_job and running_job.verb == "record"):
            return False
        return has_recording(rig)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.enabled_layout()
        running = job.current()
        if running and running.verb == "record":
            draw_job(layout, context, "record")
            draw_wrapped(layout, context, "ESC cancels as well; what is recorded is kept.", "INFO")
            return
        rig = panel_rig(context)[0]
        if rig is None:
            return
        draw_meshes(layout, context, rig)
        _draw_folder(layout, context, rig)
        draw_job(layout, context, "record", ("ERROR",))
        draw_job(layout, context, "export_skinning")
        if (advanced := draw_advanced(layout, "fdda_recording_advanced")) is not None:
            settings = rig.mesh_object.fdda.settings
            # The label is above the field, because a narrow sidebar would cut it off beside the field.
            field = advanced.column(align=True)
            field.use_property_split = False
            field.label(text=settings.bl_rna.properties["learn_from"].name)
            field.prop_search(settings, "learn_from", context.scene, "objects", text="", icon="OUTLINER_OB_MESH")
            if settings.learn_from:
                advanced.prop(settings, "pre_roll")
                advanced.prop(settings, "settle_frames")


def _draw_folder(layout: bpy.types.UILayout, context: bpy.types.Context, rig: SceneRig) -> None:
    """Draw the folder, the button of the next step, and below it the state of the recording."""
    settings = rig.mesh_object.fdda.settings
    draw_path(layout, settings, "recording", default_recording(rig.mesh_object))
    folder_content = read_content(rig)
    if isinstance(folder_content, str):
        _draw_record(layout, context, "Record", False)
        draw_wrapped(layout, context, folder_content, "ERROR")
        return
    path, content = folder_content
    check = checks.last_check(rig)
    can_record = check is not None and not check.problems
    if content.state is FolderState.COMPLETE:
        row = layout.row()
        row.scale_y = 1.3
        draw_button(row, context, "fdda.train", "Train", "PLAY", lambda each: each == rig or is_in_recording(each, rig))
        text = f"{format_poses(content.poses, content.alone_poses)}. Next: Train"
        draw_wrapped(layout, context, f"Recorded: {text}", "CHECKMARK")
    elif content.state is FolderState.INCOMPLETE:
        _draw_record(layout, context, "Resume", can_record, resume=True)
        text = f"{content.complete:,} of {content.poses:,} poses recorded. Press Resume to continue."
        draw_wrapped(layout, context, text, "INFO")
    else:
        is_free = content.state is FolderState.FREE
        _draw_record(layout, context, "Record", can_record and is_free)
        if is_free:
            draw_wrapped(layout, context, f"{_describe_poses(rig)} will go into '{path.name}'.")
    if check is not None and check.problems:
        draw_wrapped(layout, context, "The rig cannot be recorded yet; see the Rig section.", "ERROR")
    if settings.learn_from:
        draw_wrapped(layout, context, f"It learns from '{settings.learn_from}' (Advanced).", "INFO")
    if content.measured_sentence:
        draw_wrapped(layout, context, content.measured_sentence)
    if content.sentence:
        draw_wrapped(layout, context, content.sentence, "INFO" if content.state is FolderState.COMPLETE else "ERROR")
    if content.state is FolderState.COMPLETE:
        layout.operator("fdda.export_skinning", text="Export Skinning…", icon="EXPORT").object = rig.mesh_object.name
    if content.is_recording:
        layout.operator("fdda.delete_recording", text="Delete Recording…", icon="TRASH").object = rig.mesh_object.name


def _draw_record(
    layout: bpy.types.UILayout, context: bpy.types.Context, text: str, enabled: bool, resume: bool = False
) -> None:
    row = layout.row()
    row.enabled = enabled
    row.scale_y = 1.3
    draw_button(row, context, "fdda.record", text, "REC", is_recordable).resume = resume


@draw_cached
def _describe_poses(rig: SceneRig) -> str:
    settings = rig.mesh_object.fdda.settings
    frames = [len(action_frames(bpy.data.actions[name])) for name in recorded_actions(rig)]
    parts = [format_count(settings.poses, "random pose")] if settings.poses or not frames else []
    if settings.auto_poses:
        parts = [f"{POSES.default:,} to {MAX_AUTO_POSES:,} random poses"]
    if frames:
        parts.append(f"{format_count(sum(frames), 'frame')} of {format_count(len(frames), 'action')}")
        if settings.mirror:
            parts.append("their mirrored copies")
    return " and ".join(parts)


CLASSES = (FDDA_PT_recording,)
