# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the section "Model": bind and unbind a model, switch the deformation, relink."""

from pathlib import Path

import bpy

from ..core.errors import FDDAError, ModelError
from ..core.wording import format_list
from ..evaluation import side_by_side
from ..models import model_list
from ..models.model_list import active_entry, bound_model_name, format_file_size
from ..properties.character import trained_file
from ..properties.preferences import packs_models
from ..runtime.binding import check_plays, unbind
from ..runtime.model_meshes import describe_missing_meshes, find_model_rigs
from ..scene.scene_rig import SceneRig, check_full_rig, describe_left_out, left_out_reason, remaining_rig_note
from .rig_operator import NEEDS_MODEL, ModelFileOperator, RigOperator

LARGE_MODEL_BYTES = 32_000_000
"""Larger models are packed on request only, because every save writes a packed model again."""
MODE_NAMES = {"RIG": "the rig", "LINEAR": "skinning alone", "FDDA": "the model"}


def _has_model(mesh_object: bpy.types.Object) -> bool:
    """Return whether there is a model to bind: in the Model Library, or from a training."""
    return active_entry(mesh_object) is not None or trained_file(mesh_object) is not None


def bind_model(
    scene_rig: SceneRig, path: Path | None = None, is_alone: bool = False
) -> tuple[str, list[bpy.types.Object]]:
    """Bind a model to all its meshes on the armature of a rig, and pack it if the preferences say so.

    Args:
        path: file of the model; None for the active model of the Model Library, or else the trained model.
        is_alone: whether to bind the mesh of the rig alone.

    Returns:
        The message to report, and the mesh objects that play the model.

    Raises:
        FDDAError: the file is not a model of this rig, or the model cannot play.
    """
    mesh_object = scene_rig.mesh_object
    model_list.add_bound_model(mesh_object)
    if path is None and active_entry(mesh_object) is None:
        path = trained_file(mesh_object)
    if path is not None:
        # Checked first, so that no model of another rig gets into the list.
        model_list.check_matches_rig(scene_rig, path)
        entry = model_list.add_model(mesh_object, path)
    else:
        entry = model_list.require_active_entry(mesh_object)
    notes = [model_list.bind_entry(scene_rig, entry), pack_by_default(mesh_object, entry).strip()]
    info, mesh_objects = model_list.entry_info(mesh_object, entry), [mesh_object]
    if len(info.meshes) > 1 and not is_alone:
        rigs = find_model_rigs(model_list.entry_path(mesh_object, entry), info, scene_rig.armature_object)
        for other_rig in [rig for rig in rigs.values() if rig.mesh_object != mesh_object]:
            if not other_rig.mesh_object.fdda.in_model:
                notes.append(describe_left_out({other_rig.mesh_object: left_out_reason(other_rig.mesh_object)}))
                continue
            try:
                model_list.bind_entry(other_rig, model_list.copy_entry(other_rig.mesh_object, mesh_object, entry))
                mesh_objects.append(other_rig.mesh_object)
            except FDDAError as error:
                notes.append(f"Left out '{other_rig.mesh_object.name}': {error}")
        notes.append(describe_missing_meshes(info, rigs))
    names = format_list([o.name for o in mesh_objects], len(mesh_objects))
    message = f"{names} {'plays' if len(mesh_objects) == 1 else 'play'} {entry.name}."
    return " ".join(filter(None, [message, *notes])), mesh_objects


def pack_by_default(mesh_object: bpy.types.Object, entry: bpy.types.PropertyGroup) -> str:
    """Pack a model if the preferences say so and it is not large; return a text to append to the message."""
    if entry.packed or not packs_models():
        return ""
    size = model_list.entry_path(mesh_object, entry).stat().st_size
    if size > LARGE_MODEL_BYTES:
        return f" It is large ({format_file_size(size)}) and was not packed; pack it in the Model Library."
    model_list.pack_entry(mesh_object, entry)
    return ""


class FDDA_OT_bind(ModelFileOperator, bpy.types.Operator):
    bl_idname = "fdda.bind"
    bl_label = "Bind"
    bl_description = (
        "Use a model instead of the rig's modifiers: the active one of the Model Library, or a file. It is bound to "
        "each mesh that it deforms"
    )

    filepath: bpy.props.StringProperty(
        name="Model",
        description="Model file, .onnx. Empty for the active model of the list",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        try:
            has_model = any(_has_model(rig.mesh_object) for rig in self.rigs(context))
        except FDDAError:
            has_model = None
        if not (self.filepath or has_model):
            return self.open_file_browser(context)
        return self.execute(context)

    def apply(self, context: bpy.types.Context) -> str:
        rigs = self.rigs(context)
        if len(rigs) > 1:
            rigs = [rig for rig in rigs if _has_model(rig.mesh_object)] or rigs[:1]
        path = self.chosen_path() if self.filepath else None
        messages, bound_objects = [], []
        for rig in rigs:
            if rig.mesh_object not in bound_objects:
                try:
                    message, mesh_objects = bind_model(rig, path, is_alone=bool(self.object))
                except FDDAError as error:
                    # What is bound already stays bound, as one undo step.
                    if not bound_objects:
                        raise
                    message, mesh_objects = f"Left out '{rig.mesh_object.name}': {error}", []
                messages.append(message)
                bound_objects += mesh_objects
        return " ".join(messages)


class FDDA_OT_unbind(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.unbind"
    bl_label = "Unbind"
    bl_description = "Restore the modifiers of the rig. The model stays in the Model Library"
    needs = NEEDS_MODEL

    def apply(self, context: bpy.types.Context) -> str:
        names, notes = [], []
        for scene_rig in self.bound_rigs(context):
            mesh_object = scene_rig.mesh_object
            model_list.add_bound_model(mesh_object)
            names.append(bound_model_name(mesh_object))
            side_by_side.hide(mesh_object)
            unbind(mesh_object)
            notes += filter(None, [remaining_rig_note(mesh_object)])
        return " ".join([f"Unbound {' and '.join(names)}.", *notes])


class FDDA_OT_set_mode(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.set_mode"
    bl_label = "Switch Deformation"
    bl_description = "Deform the mesh with the modifiers of the rig, linear skinning alone, or the model"
    needs = NEEDS_MODEL

    mode: bpy.props.EnumProperty(
        name="Mode",
        description="What deforms the mesh",
        items=(
            ("NEXT", "Toggle", "The model if the rig is shown, else the rig"),
            ("RIG", "Rig", "The modifiers of the rig"),
            ("LINEAR", "Skinning", "Linear skinning alone"),
            ("FDDA", "Model", "The model"),
        ),
    )

    def apply(self, context: bpy.types.Context) -> str:
        rigs = self.bound_rigs(context)
        bindings = [rig.mesh_object.fdda for rig in rigs]
        mode = self.mode if self.mode != "NEXT" else ("FDDA" if bindings[0].mode == "RIG" else "RIG")
        if mode == "RIG":
            for rig in rigs:
                check_full_rig(rig.mesh_object)
        for binding in bindings:
            binding.mode = mode
        for rig in rigs:
            check_plays(rig.mesh_object)
        names = " and ".join(f"'{rig.mesh_object.name}'" for rig in rigs)
        return f"{names} {'is' if len(rigs) == 1 else 'are'} deformed by {MODE_NAMES[mode]}."


class FDDA_OT_relink(ModelFileOperator, bpy.types.Operator):
    bl_idname = "fdda.relink"
    bl_label = "Find Model"
    bl_description = "Choose where the file of the bound model is now"
    needs = NEEDS_MODEL

    def apply(self, context: bpy.types.Context) -> str:
        scene_rig = self.bound_rig(context)
        if not self.filepath:
            raise ModelError("No file was chosen; give the model's file.")
        model_list.relink(scene_rig, self.chosen_path())
        message = pack_by_default(scene_rig.mesh_object, active_entry(scene_rig.mesh_object))
        return f"'{scene_rig.mesh_object.name}' plays {self.chosen_path()}.{message}"


CLASSES = (FDDA_OT_bind, FDDA_OT_unbind, FDDA_OT_set_mode, FDDA_OT_relink)
