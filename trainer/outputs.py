# SPDX-License-Identifier: GPL-3.0-or-later
"""The files that a training on one recording or on several writes, and their checks before it starts."""

from pathlib import Path

from fdda_addon.core.errors import OutputError
from fdda_addon.core.files.file_kind import CHECKPOINT, MODEL, PAGE, REPORT
from fdda_addon.core.files.output import check_folder_writable, check_outputs
from fdda_addon.core.formats.report import checkpoint_path, page_path, report_path
from fdda_addon.core.recording.reader import open_recording


def training_outputs(model: Path) -> tuple[Path, Path, Path, Path]:
    """Return the paths of the model, its checkpoint, and its report as JSON and as a page."""
    return model, checkpoint_path(model), report_path(model), page_path(model)


def check_training_outputs(model: Path, overwrite: bool) -> None:
    """Check before a training that its files can be written.

    Args:
        model: path of the model file.
        overwrite: as in `core.files.output.check_outputs`.
    """
    check_outputs(zip(training_outputs(model), (MODEL, CHECKPOINT, REPORT, PAGE), strict=True), overwrite=overwrite)


def check_batch(recordings: list[Path], folder: Path, overwrite: bool = False) -> None:
    """Check recordings and outputs before the first of several trainings.

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
        model = batch_model_path(recording, folder)
        check_folder_writable(model.parent, [path.name for path in training_outputs(model)])
        if model.parent.is_dir():
            check_training_outputs(model, overwrite)
    for recording in recordings:
        open_recording(recording)


def batch_model_path(recording: Path, folder: Path) -> Path:
    """Return the path of the model of a recording, in the folder of the models of several recordings."""
    return folder / recording.name / f"{recording.name}.onnx"
