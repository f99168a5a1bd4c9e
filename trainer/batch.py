# SPDX-License-Identifier: GPL-3.0-or-later
"""Training on several recordings: one model for each recording, trained one after the other."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from fdda_addon.core.errors import OutputError
from fdda_addon.core.files.output import check_folder_writable
from fdda_addon.core.formats.messages import MessageType
from fdda_addon.core.recording.reader import open_recording

from .config import TrainingConfig
from .outputs import check_training_outputs, training_outputs
from .progress import MessageSink


def check_batch(recordings: list[Path], folder: Path, overwrite: bool = False) -> None:
    """Check recordings and outputs before the first training, without importing torch.

    Args:
        recordings: folders of the recordings.
        folder: folder of the models.
        overwrite: as in `check_training_outputs`.

    Raises:
        RecordingError: a recording is incomplete or damaged.
        OutputError: `folder` is the path of a model file, or a file cannot be written.
    """
    if folder.suffix == ".onnx":
        raise OutputError(
            f"'{recordings[0].parent}' holds {len(recordings)} recordings, and '{folder}' is the name of one model; "
            "give a folder for the models."
        )
    for recording in recordings:
        model = _model_path(recording, folder)
        check_folder_writable(model.parent, [path.name for path in training_outputs(model)])
        if model.parent.is_dir():
            check_training_outputs(model, overwrite)
    for recording in recordings:
        open_recording(recording)


def _model_path(recording: Path, folder: Path) -> Path:
    return folder / recording.name / f"{recording.name}.onnx"


def train_models(
    recordings: list[Path],
    folder: Path,
    config: TrainingConfig,
    sink: MessageSink,
    stoppable: Callable[[], AbstractContextManager] = nullcontext,
    warm_start: bool = False,
    strict: bool = False,
) -> None:
    """Train a model on each recording. Finished models are kept when a later training fails.

    Args:
        recordings: folders of complete recordings, which `check_batch` has checked.
        folder: folder of the models; the model of recording NAME is FOLDER/NAME/NAME.onnx.
        config, sink, stoppable, warm_start, strict: as in `train_model`.
    """
    from .train import train_model

    started = time.perf_counter()
    settings = (config, sink, stoppable, warm_start, strict, MessageType.MODEL_FINISHED)
    results = [train_model(recording, _model_path(recording, folder), *settings) for recording in recordings]
    sink.send(
        MessageType.FINISHED,
        model=str(folder),
        models=len(recordings),
        seconds=round(time.perf_counter() - started, 2),
        **{key: max(values[key] for values in results) for key in ("held_out_mm", "held_out_p999_mm")},
    )
