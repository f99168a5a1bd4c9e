# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that records a rig, trains a model on the recording, and binds the model."""

import bpy

from ..core.errors import RigError
from ..core.progress import Job
from ..jobs.plan import JobPlan
from ..properties.character import model_file, recording_folder
from ..properties.recording_options import planned_pose_count
from ..recording.rig_check import check_has_weights
from ..scene.scene_rig import SceneRig, armature_of
from .playback import bind_model
from .recording import is_recorded, record_rigs, recording_plan
from .training import TrainingOperator


class FDDA_OT_build_model(TrainingOperator, bpy.types.Operator):
    bl_idname = "fdda.build_model"
    bl_label = "Record, Train & Bind"
    bl_description = (
        "Record with the settings below, train, and bind the model, one after the other. An existing recording is used "
        "as it is. Press ESC or Cancel to stop"
    )
    bl_options = {"REGISTER"}
    verb, title = "build_model", "Record, Train & Bind"
    ends_itself = True

    def steps(self, context: bpy.types.Context) -> Job[float | None]:
        rigs = self.rigs(context)
        for rig in rigs:
            if rig.mesh_object.library is not None:
                raise RigError(f"'{rig.mesh_object.name}' is linked; make its model in the file that it comes from.")
            settings = rig.mesh_object.fdda.settings
            if settings.fit_linear == "RIG" and settings.joints == "ALL":
                check_has_weights(rig)
        files = [(rig, recording_folder(rig.mesh_object), model_file(rig.mesh_object)) for rig in rigs]
        pose_count = planned_pose_count(self.rig(context))
        trainings = [step for rig in rigs for step in self.training_plan(rig.mesh_object, pose_count)]
        missing = [(rig, recording) for rig, recording, _ in files if not is_recorded(recording)]
        self.state.plan = JobPlan([*(recording_plan(self.rig(context)) if missing else ()), *trainings])
        if missing:
            # An interrupted recording is resumed.
            resume = any((recording / "recording.json").exists() for _, recording in missing)
            for step in record_rigs(self.rig(context), missing, resume):
                yield step
                if self.state.cancel_requested:
                    return None
        self.changes_scene = self.state.changes_scene = False
        return (yield from self.train_all([(rig.mesh_object, recording, model) for rig, recording, model in files]))

    def finish(self, _context: bpy.types.Context, result: float) -> str:
        self.add_trained_models_to_list()
        sentences = []
        for uid, model in self.trained_models:
            mesh_object = next((o for o in bpy.data.objects if o.session_uid == uid), None)
            if mesh_object is not None and (armature_object := armature_of(mesh_object)) is not None:
                sentences.append(bind_model(SceneRig(mesh_object, armature_object), model))
        return f"Trained in {result:.0f} s. {' '.join(sentences)}"

    def cancel_message(self, _context: bpy.types.Context) -> str:
        self.add_trained_models_to_list()
        return "Canceled. What was recorded is kept, and the next run continues from there."


CLASSES = (FDDA_OT_build_model,)
