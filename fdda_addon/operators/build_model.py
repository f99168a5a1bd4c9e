# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that records a rig, trains a model on the recording, and binds the model."""

import bpy

from ..core.errors import RigError
from ..core.progress import Job
from ..core.recording.folder import is_recorded
from ..core.recording.index import INDEX_NAME
from ..properties.character import model_file, recording_folder
from ..recording.rig_check import check_has_weights
from ..scene.scene_rig import SceneRig, armature_of
from .playback import bind_model
from .recording import record_character, recordable_character, recording_steps
from .training import TrainingOperator, recorded_meshes


class FDDA_OT_build_model(TrainingOperator, bpy.types.Operator):
    bl_idname = "fdda.build_model"
    bl_label = "Record, Train & Bind"
    bl_description = (
        "Record with the settings below, train, and bind the model, one after the other. An existing recording is used "
        "as it is. Press ESC or Cancel to stop"
    )
    verb, title = "build_model", "Record, Train & Bind"
    ends_itself = True

    def steps(self, context: bpy.types.Context) -> Job[float | None]:
        shown = self.rig(context)
        character, self._note = recordable_character(self.rigs(context), shown)
        mesh_object = shown.mesh_object
        mesh_objects = [mesh_object, *(o for o in character.mesh_objects if o != mesh_object)]
        if mesh_object.library is not None:
            raise RigError(f"'{mesh_object.name}' is linked; make its model in the file that it comes from.")
        if mesh_object.fdda.settings.base_skinning == "RIG" and mesh_object.fdda.settings.bones_to_read == "ALL":
            check_has_weights(character)
        recording, model = recording_folder(mesh_object), model_file(mesh_object)
        is_missing = not is_recorded(recording)
        if not is_missing:
            mesh_objects, unrecorded = recorded_meshes(mesh_objects, recording)
            self._note = f"{self._note} {unrecorded}".strip()
        self.state.steps = [*(recording_steps(shown) if is_missing else ()), *self.training_steps(mesh_object)]
        if is_missing:
            # An interrupted recording is resumed.
            for step in record_character(character, mesh_object, recording, (recording / INDEX_NAME).exists()):
                yield step
                if self.state.cancel_requested:
                    return None
        self.changes_scene = self.state.changes_scene = False
        return (yield from self.train(mesh_objects, recording, model))

    def finish(self, _context: bpy.types.Context, result: float) -> str:
        mesh_objects, model = self.add_trained_model_to_list()
        sentences = []
        bound_objects: list[bpy.types.Object] = []
        for mesh_object in mesh_objects:
            armature_object = armature_of(mesh_object)
            if armature_object is not None and mesh_object not in bound_objects:
                sentence, newly_bound = bind_model(SceneRig(mesh_object, armature_object), model)
                sentences.append(sentence)
                bound_objects += newly_bound
        return " ".join(filter(None, [f"Trained in {result:.0f} s.", *sentences, self._note]))

    def cancel_message(self, _context: bpy.types.Context) -> str:
        self.add_trained_model_to_list()
        return "Canceled. What was recorded is kept, and the next run continues from there."


CLASSES = (FDDA_OT_build_model,)
