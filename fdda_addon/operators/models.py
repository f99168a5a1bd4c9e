# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the section "Model Library": add, remove and pack models."""

from pathlib import Path

import bpy

from ..core.errors import ModelError
from ..core.wording import format_count
from ..models import model_list
from ..models.model_list import format_file_size
from ..scene.scene_rig import remaining_rig_note
from .rig_operator import ModelFileOperator, RigOperator


class ModelListOperator(RigOperator):
    """Mixin for an operator on one model of the Model Library."""

    needs = (
        lambda mesh_object: bool(mesh_object.fdda.models) or mesh_object.fdda.is_bound,
        "The model library is empty; train a model, or add a file",
    )

    index: bpy.props.IntProperty(
        name="Index",
        description="Index of the model in the list. -1 for the active one",
        default=-1,
        min=-1,
        options={"SKIP_SAVE"},
    )

    def active_entry(self, context: bpy.types.Context) -> tuple[object, object]:
        """Return the rig, and the model of its list at `index`, or the active model.

        Raises:
            FDDAError: there is no rig, or no such model.
        """
        scene_rig = self.rig(context)
        mesh_object = scene_rig.mesh_object
        model_list.add_bound_model(mesh_object)
        count = len(mesh_object.fdda.models)
        if self.index >= count:
            raise ModelError(
                f"'{mesh_object.name}' has {format_count(count, 'model')} and none with index {self.index}."
            )
        if self.index < 0:
            return scene_rig, model_list.require_active_entry(mesh_object)
        return scene_rig, mesh_object.fdda.models[self.index]


class FDDA_OT_add_model(ModelFileOperator, bpy.types.Operator):
    bl_idname = "fdda.add_model"
    bl_label = "Add Model"
    bl_description = "Add a model file to the list of this mesh"

    def apply(self, context: bpy.types.Context) -> str:
        scene_rig = self.rig(context)
        if not self.filepath:
            raise ModelError("No file was chosen; choose a model file.")
        model_list.check_matches_rig(scene_rig, self.chosen_path())
        model_list.add_bound_model(scene_rig.mesh_object)
        entry = model_list.add_model(scene_rig.mesh_object, self.chosen_path())
        return f"Added {entry.name}; bind it to use it."


class FDDA_OT_remove_model(ModelListOperator, bpy.types.Operator):
    bl_idname = "fdda.remove_model"
    bl_label = "Remove Model"
    bl_description = "Remove the model from the list, and unbind it. Its file is kept; a packed model is deleted"

    def apply(self, context: bpy.types.Context) -> str:
        scene_rig, entry = self.active_entry(context)
        mesh_object = scene_rig.mesh_object
        was_bound = mesh_object.fdda.is_bound
        name = model_list.remove_entry(mesh_object, list(mesh_object.fdda.models).index(entry))
        note = remaining_rig_note(mesh_object) if was_bound else ""
        return f"Removed {name}. {note}".rstrip()


class FDDA_OT_pack_model(ModelListOperator, bpy.types.Operator):
    bl_idname = "fdda.pack_model"
    bl_label = "Pack Model"
    bl_description = "Store the model in the .blend file"

    def apply(self, context: bpy.types.Context) -> str:
        scene_rig, entry = self.active_entry(context)
        if entry.packed:
            raise ModelError(f"{entry.name} is already packed.")
        size = model_list.pack_entry(scene_rig.mesh_object, entry)
        return f"Packed {entry.name}, {format_file_size(size)}. Save the .blend file to keep it."


class FDDA_OT_unpack_model(ModelListOperator, bpy.types.Operator):
    bl_idname = "fdda.unpack_model"
    bl_label = "Unpack Model"
    bl_description = "Write the packed model to a file, and remove it from the .blend file"

    filepath: bpy.props.StringProperty(
        name="File",
        description="File to write. Empty for NAME.onnx next to the .blend file",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )

    def apply(self, context: bpy.types.Context) -> str:

        scene_rig, entry = self.active_entry(context)
        if not entry.packed:
            raise ModelError(f"{entry.name} is not packed.")
        if not self.filepath and not bpy.data.filepath:
            raise ModelError("Save the .blend file first: models are unpacked next to it.")
        name = bpy.path.clean_name(entry.name) + ".onnx"
        path = Path(bpy.path.abspath(self.filepath or f"//{name}"))
        model_list.unpack_entry(scene_rig.mesh_object, entry, path)
        return f"Unpacked {entry.name} to {path}."


CLASSES = (FDDA_OT_add_model, FDDA_OT_remove_model, FDDA_OT_pack_model, FDDA_OT_unpack_model)
