# SPDX-License-Identifier: GPL-3.0-or-later
"""The report of a training, `report.json` beside its model (docs/formats.md): its keys, reading and writing.

The trainer writes the report. The HTML page of the report and the sidebar show it.
"""

import enum
import json
from pathlib import Path

from ..errors import TrainingError, os_error_text
from ..files.input_file import read_input
from ..files.output import to_json_text
from ..json_check import NUMBER, WHOLE, check_json

REPORT_JSON, REPORT_HTML = "report.json", "report.html"
CHECKPOINT_SUFFIX = ".checkpoint.npz"
FORMAT, VERSION = "fdda-report", 1
MAX_BYTES = 1 << 27
"""Fifty times the size of a report of 100 partitions and 1000 epochs."""


class Verdict(enum.Enum):
    """Result of a training with an accuracy goal."""

    MET = "met"
    MISSED = "missed"
    """The error is above the goal; more poses may help."""
    EXHAUSTED = "exhausted"
    """The error is above the goal, and more poses no longer help."""


_ERROR_STATISTICS = dict.fromkeys(("mean", "rms", "p99", "p999", "max"), NUMBER)
_ANGLE_STATISTICS = dict.fromkeys(("mean", "p99", "max"), NUMBER)
_EDGE_ERROR_KEYS = dict.fromkeys(("inside", "beside", "across"), (NUMBER, None))
_PARTITION_KEYS = {
    "joint": str,
    "vertices": WHOLE,
    "influencing": [str],
    "controls?": [str],
    "merged?": [str],
    "features": WHOLE,
    "basis": WHOLE,
    "dropped?": WHOLE,
    "truncation": NUMBER,
    "training": _ERROR_STATISTICS,
    "held_out": _ERROR_STATISTICS,
    "linear": _ERROR_STATISTICS,
    "histogram": [WHOLE],
    "largest_errors": {
        "poses": WHOLE,
        "vertices": WHOLE,
        "truncation": NUMBER,
        "joint": str,
        "extreme": NUMBER,
        "distance": NUMBER,
        "generalization": NUMBER,
        "cause": str,
    },
    "curve": {"training": [NUMBER], "validation": [NUMBER], "worst": [NUMBER], "best_epoch": WHOLE},
}
_REPORT_KEYS = {
    "unit": str,
    "model": str,
    "model_bytes": WHOLE,
    "recording": str,
    "meshes": [{"name": str, "vertices": WHOLE, "held_out": _ERROR_STATISTICS, "linear": _ERROR_STATISTICS}],
    "vertices": WHOLE,
    "joints": WHOLE,
    "controls?": [str],
    "poses": WHOLE,
    "training": {
        **{"seconds": NUMBER, "device": str, "passes": WHOLE, "training_poses": WHOLE, "held_out_poses": WHOLE},
        "bones_to_read": str,
    },
    "parity": NUMBER,
    "fdda": {"training": _ERROR_STATISTICS, "held_out": _ERROR_STATISTICS},
    "linear": {"held_out": _ERROR_STATISTICS},
    "normals?": ({"fdda": _ANGLE_STATISTICS, "linear": _ANGLE_STATISTICS}, None),
    "edges?": ({"fdda": _EDGE_ERROR_KEYS, "linear": _EDGE_ERROR_KEYS}, None),
    "histogram": {"edges": [NUMBER], "fdda": [WHOLE], "linear": [WHOLE]},
    "partitions": [_PARTITION_KEYS],
    "warnings?": [{"name": str, "text": str}],
    "repeatability_mm?": NUMBER,
    "goal?": {"goal": NUMBER, "p999": NUMBER, "verdict": {verdict.value for verdict in Verdict}},
}
"""Keys of a report and their values, as `check_json` describes them."""


def report_path(model_path: Path) -> Path:
    """Return the path of a model's report."""
    return model_path.with_name(REPORT_JSON)


def page_path(model_path: Path) -> Path:
    """Return the path of the HTML page of a model's report."""
    return model_path.with_name(REPORT_HTML)


def checkpoint_path(model_path: Path) -> Path:
    """Return the path of a model's checkpoint, from which a training continues."""
    return model_path.with_suffix(CHECKPOINT_SUFFIX)


def report_text(report: dict) -> str:
    """Return the text of a report, with `format` and `version`; raise ValueError if keys or types are wrong."""
    check_json(report, _REPORT_KEYS)
    return to_json_text({"format": FORMAT, "version": VERSION, **report})


def read_report(path: Path) -> dict:
    """Read a report.

    Returns:
        The report. It has all required keys of docs/formats.md, and all values have the right types.

    Raises:
        TrainingError: the report cannot be read, is of another version, or is damaged.
    """
    try:
        report = json.loads(read_input(path, MAX_BYTES))
    except OSError as error:
        raise TrainingError(f"The report '{path}' cannot be read ({os_error_text(error)}); train again.") from error
    except (ValueError, RecursionError) as error:
        raise TrainingError(f"The report '{path}' cannot be read ({error}); train again.") from error
    if not isinstance(report, dict) or (report.get("format"), report.get("version")) != (FORMAT, VERSION):
        raise TrainingError(f"'{path}' is not a training report of this version; train again.")
    try:
        check_json(report, _REPORT_KEYS)
    except ValueError as error:
        raise TrainingError(f"The report '{path}' is damaged: {error}; train again.") from error
    return report
