# SPDX-License-Identifier: GPL-3.0-or-later
"""The files that a training writes, and their check before it starts."""

from pathlib import Path

from fdda_addon.core.files.file_kind import CHECKPOINT, MODEL, PAGE, REPORT
from fdda_addon.core.files.output import check_outputs
from fdda_addon.core.formats.report import checkpoint_path, page_path, report_path


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
