# SPDX-License-Identifier: GPL-3.0-or-later
"""Bases of the operators on a model."""

from pathlib import Path

import bpy

from ..core.errors import FDDAError, ModelError
from ..jobs.job import current
from ..scene.active_rig import any_mesh_object
from ..scene.scene_rig import SceneRig
from .rig_operator import RigOperator


def _is_bound(mesh_object: bpy.types.Object) -> bool:
    return mesh_object.fdda.is_bound


class ModelOperator(RigOperator):
    """Mixin for an operator on the model of a rig."""

    @classmethod
    def can_change_scene(cls, context: bpy.types.Context) -> bool:
        """Return whether there is a rig and no job changes the scene, else set the poll message. For `poll`."""
        job = current()
        if job is not None and job.changes_scene:
            cls.poll_message_set(f"{job.title} is under way; wait for it or cancel it")
            return False
        return cls.has_rig(context)

    @classmethod
    def has_bound_model(cls, context: bpy.types.Context) -> bool:
        """Return whether `can_change_scene`, and a mesh of the scene has a bound model, else set the poll message."""
        if not cls.can_change_scene(context):
            return False
        if not any_mesh_object(context, _is_bound):
            cls.poll_message_set("No model is bound; bind one first")
            return False
        return True

    def bound_rig(self, context: bpy.types.Context) -> object:
        """Return the rig to apply the operator to, which has a bound model.

        Raises:
            FDDAError: there is no rig, or no model is bound to it.
        """
        scene_rig = self.rig(context)
        if not scene_rig.mesh_object.fdda.is_bound:
            raise ModelError(f"No model is bound to '{scene_rig.mesh_object.name}'; bind one first.")
        return scene_rig

    def bound_rigs(self, context: bpy.types.Context) -> list[SceneRig]:
        """Return the rigs with a bound model to apply the operator to.

        Raises:
            FDDAError: there is no rig, or no model is bound to any of the rigs.
        """
        bound = [rig for rig in self.rigs(context) if rig.mesh_object.fdda.is_bound]
        return bound or [self.bound_rig(context)]

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            if message := self.apply(context):
                self.report({"INFO"}, message)
        except FDDAError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def apply(self, context: bpy.types.Context) -> str:
        """Do the work of the operator and return the message to report; empty for none.

        Raises:
            FDDAError: its text is reported, and the operator is canceled.
        """
        raise NotImplementedError


class ModelFileOperator:
    """Mixin for an operator on a model file, which the file browser chooses if the operator is invoked without one."""

    filepath: bpy.props.StringProperty(
        name="Model", description="Model file, .onnx", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )
    filter_glob: bpy.props.StringProperty(default="*.onnx", options={"HIDDEN"})
    check_existing: bpy.props.BoolProperty(default=False, options={"HIDDEN"})

    def open_file_browser(self, context: bpy.types.Context) -> set[str]:
        """Open the file browser in the folder of the .blend file. Blender then calls `execute`."""
        self.filepath = bpy.path.abspath("//")
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, _context: bpy.types.Context) -> None:
        # Otherwise the file browser would list the properties.
        pass

    def chosen_path(self) -> Path:
        """Return the absolute path of the chosen file."""
        return Path(bpy.path.abspath(self.filepath))
