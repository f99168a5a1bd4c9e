# SPDX-License-Identifier: GPL-3.0-or-later
"""The files that a training writes."""

from pathlib import Path

from fdda_addon.core.file_kind import MODEL, PAGE, REPORT, WEIGHTS
from fdda_addon.core.output import check_outputs
from fdda_addon.core.report import page_path, report_path, weights_path


def training_outputs(model: Path) -> tuple[Path, Path, Path, Path]:
    """The model, its last weights, and the report as JSON and as a page."""
    return model, weights_path(model), report_path(model), page_path(model)


def check_training_outputs(model: Path, overwrite: bool) -> None:
    """Fail before the training when they cannot be written; `overwrite` as in `core.output.check_outputs`.

    Raises:
        OutputError: says which and why.
    """
    check_outputs(zip(training_outputs(model), (MODEL, WEIGHTS, REPORT, PAGE), strict=True), overwrite=overwrite)
