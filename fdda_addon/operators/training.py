# SPDX-License-Identifier: GPL-3.0-or-later
"""The training: start the trainer on a character's recording and follow it."""

from collections.abc import Iterator
from pathlib import Path

import bpy

from ..core.errors import OutputError, RecordingError
from ..core.progress import Progress
from ..settings import model_file, recording_folder
from .job import JobOperator
from .on_rig import OnRig


class FDDA_OT_train(OnRig, JobOperator, bpy.types.Operator):
    bl_idname = "fdda.train"
    bl_label = "Train"
    bl_description = "Train a model on the recording, in another process; Blender can be used meanwhile"
    bl_options = {"REGISTER", "UNDO"}
    verb, title = "train", "Training"
    borrows_scene = False
    ends_itself = True

    recording: bpy.props.StringProperty(
        name="Recording",
        description="Folder of the recording; empty for that of the character",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )
    model: bpy.props.StringProperty(
        name="Model",
        description="File to write the model to; empty for that of the character",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )

    warm_start: bpy.props.BoolProperty(
        name="Train On",
        description="Start from the last weights of the model, on a recording that has grown",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        if properties.warm_start:
            return "Go on from the model's last weights, on a recording that has grown: half as long as a training"
        return cls.bl_description

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return cls.is_idle() and cls.has_rig(context)

    def steps(self, context: bpy.types.Context) -> Iterator[object]:
        from ..training import Training

        mesh_object = self.rig(context).mesh_object
        settings = mesh_object.fdda.settings
        recording = Path(bpy.path.abspath(self.recording)) if self.recording else recording_folder(mesh_object)
        model = Path(bpy.path.abspath(self.model)) if self.model else model_file(mesh_object)
        _check_recording(recording)
        _make_folder(model)
        self._model = model
        arguments = [str(recording), str(model), "--seed", str(settings.training_seed)]
        arguments += ["--tolerance-mm", f"{settings.tolerance_mm:.6g}", "--epochs", str(settings.epochs)]
        if settings.target_mm:
            arguments += ["--target-mm", f"{settings.target_mm:.6g}"]
        if self.warm_start:
            arguments += ["--warm-start"]
        self.state.curves.update(training=[], validation=[])
        # Nothing of Blender's data is used from here on: the user may do as they like.
        with Training(arguments) as training:
            for message in training.messages(wait=False):
                if self.state.cancel_requested:
                    training.cancel()
                yield self._note(message) if message is not None else None

    def _note(self, message: object) -> object:
        """What a message of the trainer is to a job: progress, a line of its log, or the result."""
        from ..core.messages import MessageType

        values, state = message.values, self.state
        if message.type is MessageType.STARTED:
            state.log.append(
                f"{values['partitions']} partitions, {values['vertices']:,} vertices, {values['poses']:,} poses, "
                f"on {values['device']}"
            )
        elif message.type is MessageType.PREPARING:
            return Progress("partitions prepared", values["done"], values["total"])
        elif message.type is MessageType.PROGRESS:
            for name, curve in state.curves.items():
                curve.append(float(values[f"{name}_mm"]))
            return Progress("epochs", values["epoch"], values["epochs"])
        elif message.type is MessageType.LOG:
            state.log.append(str(values["text"]))
        elif message.type is MessageType.FINISHED:
            return float(values["seconds"])
        return None

    def finish(self, _context: bpy.types.Context, result: float) -> str:
        # By its name: the user may have removed it meanwhile.
        mesh_object = bpy.data.objects.get(self.state.subject)
        if mesh_object is not None:
            from ..models import remember

            remember(mesh_object, self._model)
        return f"Trained '{self._model.name}' in {result:.0f} s."

    def cancelled(self, _context: bpy.types.Context) -> str:
        return "Training cancelled; no model was written."


def _check_recording(path: Path) -> None:
    """Say at once what the trainer would say after it has started."""
    from ..core.recording import read_index

    index = read_index(path)
    if index["complete"] < index["poses"]:
        raise RecordingError(
            f"The recording '{path.name}' has {index['complete']} of {index['poses']} poses; resume it first."
        )


def _make_folder(model: Path) -> None:
    try:
        model.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"Cannot make the folder '{model.parent}': {error.strerror}; choose another.") from error


CLASSES = (FDDA_OT_train,)
