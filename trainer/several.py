# SPDX-License-Identifier: GPL-3.0-or-later
"""Trains a model on each of several recordings, one after the other."""

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from fdda_addon.core.errors import OutputError, RecordingError
from fdda_addon.core.messages import MessageType
from fdda_addon.core.output import check_folder_writable
from fdda_addon.core.recording.index import read_index

from .announcements import Announcer
from .config import TrainingConfig
from .outputs import check_training_outputs, training_outputs


class _OneOfSeveral:
    """Announces the end of a training as that of one model of several."""

    def __init__(self, announcer: Announcer):
        self._announcer = announcer
        self.finished: list[dict] = []

    def say(self, kind: MessageType, **values) -> None:
        if kind is MessageType.FINISHED:
            kind = MessageType.MODEL_FINISHED
            self.finished.append(values)
        self._announcer.say(kind, **values)


def check_several(recordings: list[Path], folder: Path, overwrite: bool = False) -> None:
    """Fail before the first training, which may take long; torch is not needed to see it.

    Raises:
        RecordingError: a recording is not complete.
        OutputError: the folder is none, or cannot be written, or one of the models as `check_training_outputs`.
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
        index = read_index(recording)
        if index["complete"] < index["poses"]:
            raise RecordingError(
                f"The recording '{recording}' is incomplete: {index['complete']} of {index['poses']} poses; finish it "
                "with record --resume."
            )


def _model_path(recording: Path, folder: Path) -> Path:
    return folder / recording.name / f"{recording.name}.onnx"


def train_models(
    recordings: list[Path],
    folder: Path,
    config: TrainingConfig,
    announcer: Announcer,
    should_stop: Callable[[], bool] = lambda: False,
    warm_start: bool = False,
    strict: bool = False,
    overwrite: bool = False,
) -> None:
    """Train a model on each recording, in a folder of its own: FOLDER/NAME/NAME.onnx, by the name of its recording.

    All but `recordings` and `folder` as for `train_model`. Models that are finished stay when a later one fails.

    Raises:
        Cancelled: `should_stop` said so.
        FDDAError: as `check_several`, and as `train_model`.
    """
    from .training import train_model

    started = time.perf_counter()
    check_several(recordings, folder, overwrite)
    each = _OneOfSeveral(announcer)
    for recording in recordings:
        model = _model_path(recording, folder)
        model.parent.mkdir(parents=True, exist_ok=True)
        try:
            train_model(recording, model, config, each, should_stop, warm_start, strict, overwrite)
        finally:
            for empty in (model.parent, folder):
                with suppress(OSError):
                    empty.rmdir()
    announcer.say(
        MessageType.FINISHED,
        model=str(folder),
        models=len(recordings),
        seconds=round(time.perf_counter() - started, 2),
        **{key: max(values[key] for values in each.finished) for key in ("held_out_mm", "held_out_p999_mm")},
    )
