# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that trains a model in another process and shows the progress."""

import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..core.errors import FDDAError, OutputError, RecordingError, os_error_text
from ..core.formats.messages import WARNING_LINE, MessageType
from ..core.progress import Job, Progress
from ..core.recording.index import INDEX_NAME, read_index
from ..core.rig import read_meshes
from ..core.settings import (
    DETAIL_MM,
    GOAL_MM,
    MIN_VERTICES_PER_PART,
    PASSES,
    TRAINING_SEED,
    values_from,
)
from ..jobs.job import current
from ..jobs.state import JobStep
from ..models.former_model import add_former_model, keep_former_model
from ..models.model_list import add_model
from ..properties.character import model_file, recording_folder
from ..runtime.model_meshes import has_shape
from ..scene.scene_rig import armature_of, describe_left_out
from ..training.detached_process import AttachedTraining, DetachedTraining, is_detached
from ..training.process import Training
from .job import JobOperator

STARTING_STAGE = "starting"
FOLLOW_DELAY_SECONDS = 0.5


class TrainingOperator(JobOperator):
    """Mixin for a job operator that trains.

    The training continues after Blender quits (`training.detached_process`).
    """

    _trained: tuple[list[int], Path | None] = ([], None)
    """session_uid of the meshes, and the model file, once the training is finished."""

    def train(
        self, mesh_objects: Sequence[bpy.types.Object], recording: Path, model: Path, warm_start: bool = False
    ) -> Job[float | None]:
        """Train a model of meshes with the settings of the first, or follow its running training.

        Returns:
            The seconds; None if it was canceled.

        Raises:
            FDDAError: the recording is not complete, or the training fails.
        """
        # No data of Blender is used from here on, because the user may change it.
        mesh_uids, start, seconds = [o.session_uid for o in mesh_objects], time.monotonic(), None
        state = self.state
        state.curves.update(training=[], validation=[])
        with self._training(mesh_objects[0], recording, model, warm_start) as training:
            try:
                for message in training.messages(wait=False):
                    if state.cancel_requested:
                        training.cancel()
                    if message is not None:
                        if message.type is MessageType.FINISHED:
                            # This message may come after a cancellation, if the trainer was writing the model.
                            self._trained = mesh_uids, model
                            seconds = float(message.values["seconds"])
                        yield self._to_progress(message)
                        continue
                    if not state.total:
                        # The trainer sends no message while it loads, so show the elapsed seconds.
                        yield Progress(STARTING_STAGE, int(time.monotonic() - start), 0)
                    yield None
            except GeneratorExit:
                if not bpy.app.background:
                    # Another file is opened, or Blender quits.
                    training.detach()
                raise
        return seconds

    def training_steps(self, mesh_object: bpy.types.Object) -> list[JobStep]:
        """Return the steps of a training with the settings of a mesh."""
        settings = mesh_object.fdda.settings
        fits_weights = settings.base_skinning != "RIG" or settings.bones_to_read != "ALL"
        return [
            ("reading the recording", (STARTING_STAGE,)),
            *([("fitting the skinning", ("key joints", "fit"))] if fits_weights else ()),
            ("preparing body parts", ("partitions prepared",)),
            ("training", ("epochs",)),
        ]

    def _training(self, mesh_object: bpy.types.Object, recording: Path, model: Path, warm_start: bool) -> object:
        if not bpy.app.background and is_detached(model):
            return AttachedTraining(model)
        index = read_index(recording)
        if index["complete"] < index["poses"]:
            raise RecordingError(
                f"The recording '{recording.name}' has {index['complete']} of {index['poses']} poses; resume it first."
            )
        try:
            model.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"Cannot make the folder '{model.parent}': {os_error_text(error)}; choose another."
            ) from error
        keep_former_model(model)
        settings = mesh_object.fdda.settings
        arguments = [str(recording), str(model), TRAINING_SEED.option, str(settings.training_seed)]
        values = values_from(settings, [DETAIL_MM, PASSES, MIN_VERTICES_PER_PART, *[GOAL_MM] * settings.use_goal])
        arguments += [text for name, value in values.items() for text in (f"--{name.replace('_', '-')}", str(value))]
        if settings.base_skinning != "RIG":
            arguments += ["--base-skinning", settings.base_skinning.lower()]
        arguments += [
            "--bones-to-read",
            str(settings.bone_count) if settings.bones_to_read == "NUMBER" else settings.bones_to_read.lower(),
        ]
        if warm_start:
            arguments += ["--warm-start"]
        return Training(arguments) if bpy.app.background else DetachedTraining(arguments, model)

    def _to_progress(self, message: object) -> Progress | None:
        """Convert a message of the trainer to `Progress`; return None for other messages."""
        values, state = message.values, self.state
        if message.type is MessageType.PREPARING:
            stage = values["stage"] if values["stage"] != "partitions" else "partitions prepared"
            return Progress(stage, values["done"], values["total"])
        if message.type is MessageType.PROGRESS:
            for name, curve in state.curves.items():
                if values["epoch"] == 1:
                    curve.clear()  # the graphics card failed, and the CPU starts again
                curve.append(float(values[f"{name}_mm"]))
            return Progress("epochs", values["epoch"], values["epochs"])
        if message.type is MessageType.WARNING:
            state.warnings.append(WARNING_LINE.format(**values))
        return None

    def add_trained_model_to_list(self) -> tuple[list[bpy.types.Object], Path | None]:
        """Add the trained model to the Model Library of its meshes; return those that still exist, and the model."""
        uids, model = self._trained
        self.changes_file = bool(uids)
        mesh_objects = [o for o in bpy.data.objects if o.session_uid in uids]
        for mesh_object in mesh_objects:
            add_former_model(mesh_object, model)
            # The last one that is added is the active one.
            add_model(mesh_object, model)
        return mesh_objects, model

    def on_failure(self) -> None:
        # A training that ended before the failure has written a new file, so packed copies of it are outdated.
        with suppress(FDDAError):
            self.add_trained_model_to_list()


class FDDA_OT_train(TrainingOperator, bpy.types.Operator):
    bl_idname = "fdda.train"
    bl_label = "Train"
    bl_description = "Train a model on the recording, in the background. Training continues when Blender is closed"
    # Without UNDO: Adjust Last Operation would train again at each change.
    verb, title = "train", "Training"
    changes_scene = False
    ends_itself = True

    recording: bpy.props.StringProperty(
        name="Recording",
        description="Folder of the recording. Empty for the folder in the settings of the mesh",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )
    model: bpy.props.StringProperty(
        name="Model",
        description="File to write the model to. Empty for the file in the settings of the mesh",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )

    warm_start: bpy.props.BoolProperty(
        name="Continue Training",
        description="Continue from the last training, on a recording with more poses",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        if properties.warm_start:
            return (
                "Continue from the last training, on a recording with more poses. Takes half as long as a new training"
            )
        return cls.bl_description

    def steps(self, context: bpy.types.Context) -> Job[float | None]:
        mesh_object = self.rig(context).mesh_object
        recording = Path(bpy.path.abspath(self.recording)) if self.recording else recording_folder(mesh_object)
        model = Path(bpy.path.abspath(self.model)) if self.model else model_file(mesh_object)
        mesh_objects = [mesh_object, *(rig.mesh_object for rig in self.rigs(context) if rig.mesh_object != mesh_object)]
        mesh_objects, self._note = recorded_meshes(mesh_objects, recording)
        self.state.steps = self.training_steps(mesh_object)
        return (yield from self.train(mesh_objects, recording, model, self.warm_start))

    def finish(self, _context: bpy.types.Context, result: float) -> str:
        _, model = self.add_trained_model_to_list()
        return f"Trained '{model.name}' in {result:.0f} s. {self._note}".rstrip()

    def cancel_message(self, _context: bpy.types.Context) -> str:
        self.add_trained_model_to_list()
        return "Training canceled; no model was written."


def recorded_meshes(mesh_objects: list[bpy.types.Object], recording: Path) -> tuple[list[bpy.types.Object], str]:
    """Return the first of some meshes and those others that a recording has, and a sentence about the rest."""
    left_out = [o for o in mesh_objects[1:] if not is_mesh_recorded(o, recording)]
    sentence = describe_left_out(dict.fromkeys(left_out, "not in this recording"))
    return [o for o in mesh_objects if o not in left_out], sentence


def is_mesh_recorded(mesh_object: bpy.types.Object, recording: Path) -> bool:
    """Return whether a recording has a mesh, by its name or its shape."""
    try:
        meshes = read_meshes(read_index(recording)["meshes"])
    except FDDAError:
        # The training says what is wrong with a damaged recording.
        return (recording / INDEX_NAME).exists()
    return any(mesh.name == mesh_object.name or has_shape(mesh_object, mesh) for mesh in meshes)


def _follow_detached_training() -> None:
    """Follow a training that an earlier Blender session has started for a mesh of the open file."""
    windows = bpy.context.window_manager.windows
    if current() is not None or not windows:
        return
    for mesh_object in bpy.data.objects:
        if mesh_object.type != "MESH" or mesh_object.library or armature_of(mesh_object) is None:
            continue
        try:
            has_detached_training = is_detached(model_file(mesh_object))
        except FDDAError:
            continue
        if has_detached_training and mesh_object.name in bpy.context.scene.objects:
            with bpy.context.temp_override(window=windows[0]):
                bpy.ops.fdda.train("INVOKE_DEFAULT", object=mesh_object.name)
            return


@persistent
def _on_load(*_: object) -> None:
    if not bpy.app.background and not bpy.app.timers.is_registered(_follow_detached_training):
        bpy.app.timers.register(_follow_detached_training, first_interval=FOLLOW_DELAY_SECONDS)


CLASSES = (FDDA_OT_train,)


HANDLERS = {"load_post": _on_load}


def register() -> None:
    """Schedule `_follow_detached_training` for the file that is open when the add-on is enabled."""
    _on_load()


def unregister() -> None:
    """Undo `register`."""
    if bpy.app.timers.is_registered(_follow_detached_training):
        bpy.app.timers.unregister(_follow_detached_training)
