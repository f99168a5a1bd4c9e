# SPDX-License-Identifier: GPL-3.0-or-later
"""Base class of operators on a rig: the active rig, or the rig of a named mesh object."""

from pathlib import Path

import bpy

from ..core.errors import FDDAError, ModelError, RigError
from ..core.sentences.window import for_window
from ..jobs.job import current
from ..scene.active_rig import active_rig, any_mesh_object, cached_active_rig, rigs_together
from ..scene.scene_rig import SceneRig, armature_of, join_rigs

NEEDS_MODEL = (lambda mesh_object: mesh_object.fdda.is_bound, "No model is bound; bind one first")
"""`RigOperator.needs` of operators on a bound model."""
OBJECT_OR_POSE_MODE = frozenset({"OBJECT", "POSE"})


class RigOperator:
    """Mixin for an operator on a rig.

    A subclass defines `apply`. The text of an FDDAError is reported, and the operator is canceled.
    """

    bl_options = {"REGISTER", "UNDO"}
    needs = None
    """What a mesh of the scene must have: a function of its object, and the poll message if no mesh has it."""
    waits_for_jobs = True
    """Whether the operator is disabled while a job changes the scene."""
    waits_for_all_jobs = False
    """Whether the operator is disabled while any job on a character runs."""
    modes = frozenset()
    """The modes in which the operator is available; empty for all."""

    object: bpy.props.StringProperty(
        name="Object",
        description="Name of the mesh object. Empty for the active object",
        options={"SKIP_SAVE"},
    )
    all_meshes: bpy.props.BoolProperty(
        name="All Meshes",
        description="Apply to all checked meshes of the armature",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if problem := cls.poll_problem(context):
            cls.poll_message_set(problem)
        return not problem

    @classmethod
    def poll_problem(cls, context: bpy.types.Context) -> str:
        """Return why the operator is disabled; empty if it is enabled."""
        job = current()
        if job is not None and (cls.waits_for_all_jobs or (cls.waits_for_jobs and job.changes_scene)):
            return job.busy_text
        if cls.modes and context.mode not in cls.modes:
            return "Only available in Object Mode and Pose Mode"
        # The rig need not be active: a script may name its object.
        if cached_active_rig(context) is None and not any_mesh_object(context, armature_of):
            try:
                active_rig(context)
            except RigError as error:
                return str(error).rstrip(".")
        if cls.needs and not any_mesh_object(context, cls.needs[0]):
            return cls.needs[1]
        return ""

    def rig(self, context: bpy.types.Context) -> SceneRig:
        """Return the rig to apply the operator to."""
        return active_rig(context, self.object)

    def rigs(self, context: bpy.types.Context) -> list[SceneRig]:
        """Return the rigs to apply the operator to: with `all_meshes` those of all checked meshes, else one rig."""
        together = rigs_together(context) if self.all_meshes and not self.object else []
        return together or [self.rig(context)]

    def character(self, context: bpy.types.Context) -> SceneRig:
        """Return the rig of all meshes to apply the operator to."""
        return join_rigs(self.rigs(context))

    def bound_rig(self, context: bpy.types.Context) -> SceneRig:
        """Return the rig to apply the operator to, which has a bound model.

        Raises:
            FDDAError: there is no rig, or no model is bound to it.
        """
        scene_rig = self.rig(context)
        if not scene_rig.mesh_object.fdda.is_bound:
            raise ModelError(f"No model is bound to '{scene_rig.mesh_object.name}'; bind one first.")
        return scene_rig

    def bound_rigs(self, context: bpy.types.Context) -> list[SceneRig]:
        """Return the rigs with a bound model to apply the operator to."""
        bound = [rig for rig in self.rigs(context) if rig.mesh_object.fdda.is_bound]
        return bound or [self.bound_rig(context)]

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            if message := self.apply(context):
                self.report({"INFO"}, for_window(message))
        except FDDAError as error:
            self.report({"ERROR"}, for_window(str(error)))
            return {"CANCELLED"}
        return {"FINISHED"}

    def apply(self, context: bpy.types.Context) -> str:
        """Do the work of the operator and return the message to report; empty for none."""
        raise NotImplementedError


class ModelFileOperator(RigOperator):
    """Mixin for an operator on a model file, which the file browser chooses if the operator is invoked without one."""

    filepath: bpy.props.StringProperty(
        name="Model", description="Model file, .onnx", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )
    filter_glob: bpy.props.StringProperty(default="*.onnx", options={"HIDDEN"})
    check_existing: bpy.props.BoolProperty(default=False, options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        return self.execute(context) if self.filepath else self.open_file_browser(context)

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
