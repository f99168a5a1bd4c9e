# SPDX-License-Identifier: GPL-3.0-or-later
"""Section "Model": binds a model, switches the deformation, and shows speed and confidence of the model."""

from pathlib import Path

import bpy

from ..models.model_list import active_entry, bound_model_name
from ..rig.modifier_stack import is_playback_modifier
from ..runtime.confidence import partition_confidence
from ..scene.active_rig import cached_rigs_together
from ..scene.draw_cache import draw_cached
from ..scene.folder_trust import is_trusted
from ..scene.scene_rig import SceneRig, armature_of, remaining_rig_note
from ..scene.stored_paths import resolve_path
from .frame_profile import draw_times
from .meshes import draw_meshes
from .section import Section, draw_advanced, draw_button, draw_job, draw_wrapped, is_bound, panel_rig, short_bone_name
from .timed_value import timed_values
from .trained_file import find_trained_file

FULL_CONFIDENCE = 0.995
MAX_SHOWN_PARTITIONS = 6


@draw_cached
def is_outside_model_folders(mesh_object: bpy.types.Object) -> bool:
    """Return whether the bound model lies outside the folders from which the .blend file may load models."""
    model_path = resolve_path(mesh_object.fdda.model, mesh_object.library).resolve()
    blend_path = Path(bpy.data.filepath).resolve()
    return bool(bpy.data.filepath) and not model_path.is_relative_to(blend_path.parent) and not is_trusted(model_path)


def mask_problem(mesh_object: bpy.types.Object) -> str:
    """Return a message about a missing vertex group of the mask; empty without a problem."""
    name = mesh_object.fdda.mask
    if not name or name in mesh_object.vertex_groups:
        return ""
    return f"'{mesh_object.name}' has no vertex group '{name}', so the mask has no effect; choose another."


def _read_confidence(mesh_object: bpy.types.Object) -> object:
    return partition_confidence(mesh_object) or "No confidence values: the model has none, or the pose cannot be read."


CONFIDENCE_SECONDS = 0.2
"""Time between two evaluations of the confidence, while the panel is drawn."""


class FDDA_PT_playback(Section, bpy.types.Panel):
    bl_idname = "FDDA_PT_playback"
    bl_label = "Model"
    verbs = ("bake", "fast_rig")

    @classmethod
    def is_done(cls, context: bpy.types.Context) -> bool:
        rig = panel_rig(context)[0]
        return rig is not None and rig.mesh_object.fdda.is_bound and not rig.mesh_object.fdda.status

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.enabled_layout()
        scene_rig, reason = panel_rig(context)
        if scene_rig is None:
            draw_wrapped(layout, context, reason, "INFO")
            return
        mesh_object = scene_rig.mesh_object
        if note := remaining_rig_note(mesh_object):
            draw_wrapped(layout, context, note, "ERROR")
        draw_meshes(layout, context, scene_rig, playback=True)
        if not mesh_object.fdda.is_bound:
            self._draw_unbound(context, scene_rig)
            return
        self._draw_bound(context, mesh_object)
        if not mesh_object.fdda.status:
            self._draw_confidence(context, mesh_object)
            if not draw_job(layout, context, "bake"):
                draw_button(layout, context, "fdda.bake", "Bake…", "EXPORT", is_bound)
            if mesh_object.fdda.is_fast_rig:
                text = (
                    "This is a fast rig: it lacks modifiers and bones of the full rig. For rendering, relocate the "
                    "library to the file of the full rig."
                )
                draw_wrapped(layout, context, text, "INFO")
            elif not draw_job(layout, context, "fast_rig"):
                layout.operator("fdda.fast_rig", text="Fast Rig…", icon="ARMATURE_DATA")
        draw_button(layout, context, "fdda.unbind", "Unbind", "UNLINKED", is_bound)
        if not mesh_object.fdda.status and (advanced := draw_advanced(layout, "fdda_model_advanced")) is not None:
            # Draw the vertex group that limits the model.
            binding = mesh_object.fdda
            mask = advanced.row(align=True)
            mask.enabled = binding.mode == "FDDA"
            mask.prop_search(binding, "mask", mesh_object, "vertex_groups")
            invert = mask.row(align=True)
            invert.active = bool(binding.mask)
            invert.prop(binding, "invert_mask", text="", icon="ARROW_LEFTRIGHT")

    def _draw_unbound(self, context: bpy.types.Context, rig: SceneRig) -> None:
        mesh_object = rig.mesh_object
        layout, entry, trained = self.layout, active_entry(mesh_object), find_trained_file(rig)
        if mesh_object.fdda.status:
            draw_wrapped(layout, context, mesh_object.fdda.status, "ERROR")
        if entry is None and (trained is None or trained.mismatch):
            draw_wrapped(layout, context, "No model yet: train one above, or choose a file.", "INFO")
            layout.operator("fdda.bind", text="Choose Model and Bind…", icon="FILEBROWSER")
            return
        column = layout.column()
        column.scale_y = 1.4
        name = entry.name if entry is not None else trained.path.stem
        # A model binds the meshes that it deforms, so the button names it, and no number of meshes.
        button = column.operator("fdda.bind", text=f"Bind {name}", icon="LINKED")
        button.all_meshes = bool(cached_rigs_together(context))

    def _draw_bound(self, context: bpy.types.Context, mesh_object: bpy.types.Object) -> None:
        layout, binding = self.layout, mesh_object.fdda
        suffix = " (in this file)" if binding.packed else ""
        layout.label(text=f"{bound_model_name(mesh_object)}{suffix}", icon="ERROR" if binding.status else "LINKED")
        if not binding.packed and not binding.status and is_outside_model_folders(mesh_object):
            text = "The model is not packed, and not in the folder of this file: it will not load again."
            draw_wrapped(layout, context, text, "ERROR")
            layout.operator("fdda.pack_model", text="Pack into the .blend File", icon="PACKAGE")
        if binding.status:
            box = layout.box()
            box.alert = True
            draw_wrapped(box, context, binding.status)
        # A warning leaves the model playing.
        if binding.status and not binding.is_playing:
            row = layout.row(align=True)
            row.operator("fdda.relink", text="Find Model…", icon="FILEBROWSER")
            if any(map(is_playback_modifier, mesh_object.modifiers)):
                row.operator("fdda.set_mode", text="Try Again", icon="FILE_REFRESH").mode = "FDDA"
            else:
                row.operator("fdda.bind", text="Bind Again", icon="LINKED").object = mesh_object.name
            return
        row = layout.row(align=True)
        row.scale_y = 1.4
        modes = binding.bl_rna.properties["mode"].enum_items
        modes = [mode for mode in modes if mode.identifier != "RIG" or not mesh_object.fdda.is_fast_rig]
        if cached_rigs_together(context):
            for mode in modes:
                properties = row.operator("fdda.set_mode", text=mode.name, depress=binding.mode == mode.identifier)
                properties.mode, properties.all_meshes = mode.identifier, True
        else:
            for mode in modes:
                row.prop_enum(binding, "mode", mode.identifier)
        if not mesh_object.fdda.is_fast_rig:
            draw_times(layout, context, armature_of(mesh_object))
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        strength = column.row()
        strength.enabled = binding.mode == "FDDA"
        strength.prop(binding, "strength", slider=True)
        column.prop(binding, "use_in_render")
        if text := mask_problem(mesh_object):
            draw_wrapped(layout, context, text, "ERROR")

    def _draw_confidence(self, context: bpy.types.Context, mesh_object: bpy.types.Object) -> None:
        # While the sub-panel is closed the model is not evaluated.
        header, body = self.layout.panel("fdda_confidence", default_closed=True)
        header.label(text="Confidence in This Pose")
        if body is None:
            return
        confidence = timed_values.get(_read_confidence, mesh_object, CONFIDENCE_SECONDS)
        if confidence is None or isinstance(confidence, str):
            draw_wrapped(body, context, confidence or "…")
            return
        partitions_beyond_range = [(name, value) for name, value in confidence if value < FULL_CONFIDENCE]
        if not partitions_beyond_range:
            draw_wrapped(body, context, "This pose is inside the trained range.", "CHECKMARK")
            return
        draw_wrapped(
            body,
            context,
            f"{len(partitions_beyond_range)} of {len(confidence)} body parts are beyond the trained range:",
        )
        column = body.column(align=True)
        for name, value in partitions_beyond_range[:MAX_SHOWN_PARTITIONS]:
            row = column.split(factor=0.5, align=True)
            row.label(text=short_bone_name(name))
            row.progress(factor=value, text=f"{100 * value:.0f} %")
        if len(partitions_beyond_range) > MAX_SHOWN_PARTITIONS:
            column.label(text=f"and {len(partitions_beyond_range) - MAX_SHOWN_PARTITIONS} more")


CLASSES = (FDDA_PT_playback,)
