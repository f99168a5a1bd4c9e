# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the section Playback: bind, switch, measure, relink, unbind."""

from collections.abc import Iterator
from pathlib import Path

import bpy

from ..core.errors import FDDAError, ModelError
from ..model_list import bound_name, chosen_entry
from .job import JobOperator, current
from .on_rig import OnRig

MODE_NAMES = {"RIG": "the rig", "LINEAR": "the linear layer", "FDDA": "the model"}


class OnModel(OnRig):
    """Mixin for an operator that works on the model of a rig, as long as no job changes the scene."""

    @classmethod
    def is_free(cls, context: bpy.types.Context) -> bool:
        """Whether there is a rig and no job borrows the scene; sets the poll message otherwise. For `poll`."""
        job = current()
        if job is not None and job.borrows_scene:
            cls.poll_message_set(f"{job.title} is under way; wait for it or cancel it")
            return False
        return cls.has_rig(context)

    @classmethod
    def has_bound(cls, context: bpy.types.Context) -> bool:
        """As `is_free`, and the active rig, or some other, has a model that is bound."""
        if not cls.is_free(context):
            return False
        if not any(o.type == "MESH" and o.fdda.is_bound for o in context.scene.objects):
            cls.poll_message_set("No model is bound; bind one first")
            return False
        return True

    def bound_rig(self, context: bpy.types.Context) -> object:
        """The rig that is meant, which has a model.

        Raises:
            FDDAError: there is no rig, or no model is bound to it.
        """
        scene_rig = self.rig(context)
        if not scene_rig.mesh_object.fdda.is_bound:
            raise ModelError(f"No model is bound to '{scene_rig.mesh_object.name}'; bind one first.")
        return scene_rig

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            self.report({"INFO"}, self.work(context))
        except FDDAError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def work(self, context: bpy.types.Context) -> str:
        """Do it; returns the sentence that is reported.

        Raises:
            FDDAError: its text is reported, and the operator is cancelled.
        """
        raise NotImplementedError


class ChoosesModel:
    """Mixin for an operator that takes the path of a model, and asks for it when it is invoked without."""

    filepath: bpy.props.StringProperty(name="Model", description="The model, an .onnx file", subtype="FILE_PATH")
    filter_glob: bpy.props.StringProperty(default="*.onnx", options={"HIDDEN"})
    check_existing: bpy.props.BoolProperty(default=False, options={"HIDDEN"})

    def choose(self, context: bpy.types.Context) -> set[str]:
        """Open the file browser in the folder of the .blend file; `execute` follows."""
        self.filepath = bpy.path.abspath("//")
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, _context: bpy.types.Context) -> None:
        # The file browser would list the properties.
        pass

    def path(self) -> Path:
        """The path that was chosen."""
        return Path(bpy.path.abspath(self.filepath))


class FDDA_OT_bind(OnModel, ChoosesModel, bpy.types.Operator):
    bl_idname = "fdda.bind"
    bl_label = "Bind"
    bl_description = (
        "Let a model play in place of the rig's modifiers, the one that is chosen in the list unless a file is given"
    )
    bl_options = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(
        name="Model", description="The model, an .onnx file; empty for the one chosen in the list", subtype="FILE_PATH"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return cls.is_free(context)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        try:
            listed = chosen_entry(self.rig(context).mesh_object)
        except FDDAError:
            listed = None
        if self.filepath or listed:
            return self.execute(context)
        return self.choose(context)

    def work(self, context: bpy.types.Context) -> str:
        from .. import models

        scene_rig = self.rig(context)
        mesh_object = scene_rig.mesh_object
        models.adopt(mesh_object)
        if self.filepath:
            # Before it is put into the list: what is no model of this rig does not belong there.
            models.check(scene_rig, self.path())
            entry = models.remember(mesh_object, self.path())
        else:
            entry = models.chosen(mesh_object)
        models.bind_entry(scene_rig, entry)
        return f"'{mesh_object.name}' plays {entry.name}."


class FDDA_OT_unbind(OnModel, bpy.types.Operator):
    bl_idname = "fdda.unbind"
    bl_label = "Unbind"
    bl_description = "Give the mesh back to its rig, with the modifiers as they were; the model stays in the list"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return cls.has_bound(context)

    def work(self, context: bpy.types.Context) -> str:
        from .. import models
        from ..runtime.binding import unbind

        mesh_object = self.bound_rig(context).mesh_object
        models.adopt(mesh_object)
        name = bound_name(mesh_object)
        unbind(mesh_object)
        return f"'{mesh_object.name}' is deformed by its rig again; {name} is unbound."


class FDDA_OT_switch(OnModel, bpy.types.Operator):
    bl_idname = "fdda.switch"
    bl_label = "Switch Deformation"
    bl_description = "Choose what deforms the mesh: the modifiers of the rig, linear skinning alone, or the model"
    bl_options = {"REGISTER", "UNDO"}

    mode: bpy.props.EnumProperty(
        name="Mode",
        description="What deforms the mesh",
        items=(
            ("NEXT", "Other", "The model if the rig is shown, else the rig"),
            ("RIG", "Rig", "The modifiers of the rig"),
            ("LINEAR", "Linear Layer", "Linear skinning alone"),
            ("FDDA", "FDDA", "The model"),
        ),
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return cls.has_bound(context)

    def work(self, context: bpy.types.Context) -> str:
        mesh_object = self.bound_rig(context).mesh_object
        binding = mesh_object.fdda
        mode = self.mode if self.mode != "NEXT" else ("FDDA" if binding.mode == "RIG" else "RIG")
        binding.mode = mode
        context.view_layer.update()
        if binding.status:
            raise ModelError(binding.status)
        return f"'{mesh_object.name}' is deformed by {MODE_NAMES[mode]}."


class FDDA_OT_relink(OnModel, ChoosesModel, bpy.types.Operator):
    bl_idname = "fdda.relink"
    bl_label = "Find Model…"
    bl_description = "Say where the file of the bound model is now, and play it"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return cls.has_bound(context)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        return self.execute(context) if self.filepath else self.choose(context)

    def work(self, context: bpy.types.Context) -> str:
        from .. import models

        scene_rig = self.bound_rig(context)
        if not self.filepath:
            raise ModelError("No file was chosen; give the model's file.")
        models.adopt(scene_rig.mesh_object)
        models.relink(scene_rig, self.path())
        return f"'{scene_rig.mesh_object.name}' plays {self.path()}."


class FDDA_OT_measure_model(OnModel, JobOperator, bpy.types.Operator):
    bl_idname = "fdda.measure_model"
    bl_label = "Measure"
    bl_description = "Time a frame of the rig, of linear skinning and of the model, in turn"
    bl_options = {"REGISTER"}
    verb, title = "measure_model", "Measurement"

    frames: bpy.props.IntProperty(name="Frames", description="Frames to time, each way", default=50, min=5, max=10000)

    execute = JobOperator.execute

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return cls.is_idle() and cls.has_bound(context)

    def steps(self, context: bpy.types.Context) -> Iterator[object]:
        from ..benchmark import benchmark
        from ..runtime.binding import true_rig

        scene_rig = self.bound_rig(context)
        with true_rig(scene_rig.mesh_object):
            yield from benchmark(scene_rig, None, self.frames)

    def finish(self, context: bpy.types.Context, result: object) -> str:
        from .. import frame_times

        mesh_object = self.bound_rig(context).mesh_object
        times = frame_times.keep(mesh_object, result)
        return (
            f"A frame of '{mesh_object.name}' takes {times.rig:.2f} ms with the rig and {times.fdda:.2f} ms with FDDA."
        )


CLASSES = (FDDA_OT_bind, FDDA_OT_unbind, FDDA_OT_switch, FDDA_OT_relink, FDDA_OT_measure_model)
