# SPDX-License-Identifier: GPL-3.0-or-later
"""Section "Model Library": lists and packs the models of a mesh, and shows changes of the rig since their training."""

import bpy

from ..core.errors import FDDAError
from ..core.formats.model_info import ModelInfo
from ..core.mathematics.poses import CONTROL, ROTATION_VECTOR, Channel, bones_with_changed_range
from ..core.rig import Rig, rig_differences
from ..core.wording import format_list
from ..models.model_list import active_entry, entry_info, entry_info_of_mesh, format_file_size, is_bound
from ..properties.recording_options import bones_to_pose
from ..rig.reading import read_model_rig
from ..scene.draw_cache import computed_once
from ..scene.scene_rig import SceneRig, armature_of
from ..scene.stored_paths import resolve_path
from . import checks
from .section import Section, draw_wrapped, panel_rig
from .timed_value import timed_values


def rig_of_model(scene_rig: object, rig: object, info: object) -> object:
    """Return a rig with the joints of a model, read from the scene if the checked rig has other joints."""
    if set(rig.joint_names) == set(info.joint_names):
        return rig
    name, inputs = ("rig of a model", scene_rig.mesh_object.session_uid), (rig, info.joint_names)
    return computed_once(name, inputs, lambda: read_model_rig(scene_rig, info))


def _find_problems(mesh_object: bpy.types.Object) -> dict[str, tuple[str, str]]:
    """Return icon and message of each model of a mesh that has a problem, by `_entry_key`."""
    armature_object = armature_of(mesh_object)
    scene_rig = SceneRig(mesh_object, armature_object)
    check = checks.last_check(scene_rig) if armature_object else None
    problems = {}
    for entry in mesh_object.fdda.models:
        try:
            info = entry_info_of_mesh(mesh_object, entry)
            if check is not None and check.rig is not None:
                rig = rig_of_model(scene_rig, check.rig, info)
                channels = _compared_channels(scene_rig, check.channels, info)
                if (problem := _describe_changes(entry.name, info, rig, channels)) is not None:
                    problems[_entry_key(entry)] = problem
        except FDDAError as error:
            problems[_entry_key(entry)] = ("ERROR", str(error))
    return problems


def _describe_changes(name: str, info: ModelInfo, rig: Rig, channels: tuple[Channel, ...]) -> tuple[str, str] | None:
    """Describe how a rig with the joints of a model, and its ranges of motion, differ from those of its training.

    Returns:
        An icon and a message. None without a difference.
    """
    if differences := rig_differences(info.joints, info.rest_matrices, info.meshes, rig):
        return "ERROR", (
            f"{name} was trained for an earlier state of this rig: {'; '.join(differences)}. "
            "Undo the change, or record and train again."
        )
    # Ranges of control bones and of actions are chosen by the user and not compared.
    has_joint_ranges = all(c.name in rig.joint_names and c.kind != ROTATION_VECTOR for c in info.limits)
    if not (info.limits and has_joint_ranges and (names := bones_with_changed_range(info.limits, channels))):
        return None
    return "INFO", (
        f"The range of motion of {format_list(names)} has changed since {name} was trained: it plays, but may be less "
        "exact there. Record and train again."
    )


def _compared_channels(
    scene_rig: SceneRig, channels: "tuple[Channel, ...]", info: "ModelInfo"
) -> "tuple[Channel, ...]":
    """Return the rig's ranges to compare with those of a model; the model's own if the user chose the posed bones."""
    if bones_to_pose(scene_rig) != "WEIGHTS":
        return info.limits
    return tuple(channel for channel in channels if channel.kind != CONTROL)


def _entry_key(entry: bpy.types.PropertyGroup) -> str:
    return f"{entry.name}\n{entry.path}\n{entry.packed_bytes}"


PROBLEMS_SECONDS = 0.5
"""Time between two searches for problems, while the panel is drawn."""


class FDDA_UL_models(bpy.types.UIList):
    bl_idname = "FDDA_UL_models"

    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index):
        mesh_object = data.id_data
        row = layout.row(align=True)
        row.prop(item, "name", text="", emboss=False, icon="LINKED" if is_bound(mesh_object, item) else "BLANK1")
        if item.packed:
            row.label(text=format_file_size(item.packed_bytes), icon="PACKAGE")
        problems = timed_values.get(_find_problems, mesh_object, PROBLEMS_SECONDS) or {}
        if (problem := problems.get(_entry_key(item))) is not None:
            row.label(icon=problem[0])


class FDDA_PT_models(Section, bpy.types.Panel):
    bl_idname = "FDDA_PT_models"
    bl_label = "Model Library"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.enabled_layout()
        scene_rig, reason = panel_rig(context)
        if scene_rig is None:
            draw_wrapped(layout, context, reason, "INFO")
            return
        mesh_object = scene_rig.mesh_object
        binding = mesh_object.fdda
        if not binding.models and not binding.is_bound:
            draw_wrapped(layout, context, "No model yet: train one above, or add a file.", "INFO")
            layout.operator("fdda.add_model", text="Add Model…", icon="ADD")
            return
        row = layout.row()
        row.template_list("FDDA_UL_models", "", binding, "models", binding, "model_index", rows=3)
        column = row.column(align=True)
        column.operator("fdda.add_model", text="", icon="ADD")
        column.operator("fdda.remove_model", text="", icon="REMOVE")
        entry = active_entry(mesh_object)
        if entry is not None:
            problems = timed_values.get(_find_problems, mesh_object, PROBLEMS_SECONDS)
            problem = (problems or {}).get(_entry_key(entry))
            if is_bound(mesh_object, entry):
                layout.operator("fdda.unbind", icon="UNLINKED")
            else:
                row = layout.row()
                row.scale_y = 1.2
                row.operator("fdda.bind", text=f"Bind {entry.name}", icon="LINKED").filepath = ""
            if entry.packed:
                draw_wrapped(layout, context, f"Packed, {format_file_size(entry.packed_bytes)}", "PACKAGE")
                layout.operator("fdda.unpack_model", icon="EXPORT")
            else:
                draw_wrapped(layout, context, str(resolve_path(entry.path)), "FILE")
                layout.operator("fdda.pack_model", text="Pack into the .blend File", icon="PACKAGE")
            if problem is not None:
                box = layout.box()
                box.alert = problem[0] == "ERROR"
                draw_wrapped(box, context, problem[1], problem[0])
            elif problems is not None:
                draw_wrapped(layout, context, "Matches this rig", "CHECKMARK")
                if sentence := entry_info(mesh_object, entry).skin_sentence:
                    draw_wrapped(layout, context, sentence)


CLASSES = (FDDA_UL_models, FDDA_PT_models)


def unregister() -> None:
    """Stop the timer."""
    timed_values.stop()
