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

REPORT_JSON, REPORT_HTML = "report.json", "report.html"
CHECKPOINT_SUFFIX = ".checkpoint.npz"
FORMAT, VERSION = "fdda-report", 1
MAX_BYTES = 1 << 27
"""Fifty times the size of a report of 100 partitions and 1000 epochs."""
MAX_ABSOLUTE_VALUE = 1e300
"""Largest absolute value of a number in a report."""


class Verdict(enum.Enum):
    """Result of a training with an accuracy goal."""

    MET = "met"
    MISSED = "missed"
    """The error is above the goal; more poses may help."""
    EXHAUSTED = "exhausted"
    """The error is above the goal, and more poses no longer help."""


_ERROR_STATISTICS = dict.fromkeys(("mean", "rms", "p99", "p999", "max"), float)
_ANGLE_STATISTICS = dict.fromkeys(("mean", "p99", "max"), float)
_EDGE_ERROR_KEYS = dict.fromkeys(("inside", "beside", "across"), (float, None))
_PARTITION_KEYS = {
    "joint": str,
    "vertices": int,
    "influencing": [str],
    "controls?": [str],
    "merged?": [str],
    "features": int,
    "basis": int,
    "dropped?": int,
    "truncation": float,
    "training": _ERROR_STATISTICS,
    "held_out": _ERROR_STATISTICS,
    "linear": _ERROR_STATISTICS,
    "histogram": [int],
    "largest_errors": {
        "poses": int,
        "vertices": int,
        "truncation": float,
        "joint": str,
        "extreme": float,
        "distance": float,
        "generalization": float,
        "cause": str,
    },
    "curve": {"training": [float], "validation": [float], "worst": [float], "best_epoch": int},
}
_REPORT_KEYS = {
    "unit": str,
    "model": str,
    "model_bytes": int,
    "recording": str,
    "meshes": [{"name": str, "vertices": int, "held_out": _ERROR_STATISTICS, "linear": _ERROR_STATISTICS}],
    "vertices": int,
    "joints": int,
    "controls?": [str],
    "poses": int,
    "training": {
        **{"seconds": float, "device": str, "passes": int, "training_poses": int, "held_out_poses": int},
        "bones_to_read": str,
    },
    "parity": float,
    "constant_bytes?": int,
    "fdda": {"training": _ERROR_STATISTICS, "held_out": _ERROR_STATISTICS},
    "linear": {"held_out": _ERROR_STATISTICS},
    "normals?": ({"fdda": _ANGLE_STATISTICS, "linear": _ANGLE_STATISTICS}, None),
    "edges?": ({"fdda": _EDGE_ERROR_KEYS, "linear": _EDGE_ERROR_KEYS}, None),
    "histogram": {"edges": [float], "fdda": [int], "linear": [int]},
    "partitions": [_PARTITION_KEYS],
    "warnings?": [{"name": str, "text": str}],
    "repeatability_mm?": float,
    "goal?": {"goal": float, "p999": float, "verdict": Verdict},
}
"""Keys of a report and the types of their values. `?` marks an optional key, a pair with None a value that may
be null; further keys are permitted."""
_EVALUATION_KEYS = {"poses": int, "fdda": _ERROR_STATISTICS, "linear": _ERROR_STATISTICS}
"""Keys of the JSON that `evaluate` writes, as far as the page of a report shows them."""


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
    _check_value(report, _REPORT_KEYS, "")
    return to_json_text({"format": FORMAT, "version": VERSION, **report})


def read_report(path: Path) -> dict:
    """Read a report.

    Returns:
        The report. It has all required keys of docs/formats.md, and all values have the right types.

    Raises:
        TrainingError: the report cannot be read, is of another version, or is damaged.
    """
    report = _read_json(path, f"The report '{path}'", "train again")
    if not isinstance(report, dict) or (report.get("format"), report.get("version")) != (FORMAT, VERSION):
        raise TrainingError(f"'{path}' is not a training report of this version; train again.")
    try:
        _check_value(report, _REPORT_KEYS, "")
    except ValueError as error:
        raise TrainingError(f"The report '{path}' is damaged: {error}; train again.") from error
    return report


def read_evaluation(path: Path) -> dict:
    """Read the JSON that `evaluate` wrote; returns at least `_EVALUATION_KEYS`.

    Raises:
        TrainingError: the file cannot be read, is damaged, or is of another kind.
    """
    evaluation = _read_json(path, f"The evaluation '{path}'", "evaluate again")
    try:
        _check_value(evaluation, _EVALUATION_KEYS, "")
    except ValueError as error:
        raise TrainingError(f"The evaluation '{path}' is damaged: {error}; evaluate again.") from error
    return evaluation


def _read_json(path: Path, file_text: str, advice: str) -> object:
    """Read a JSON file; its errors start with `file_text` and end with `advice`."""
    try:
        return json.loads(read_input(path, MAX_BYTES))
    except OSError as error:
        raise TrainingError(f"{file_text} cannot be read ({os_error_text(error)}); {advice}.") from error
    except (ValueError, RecursionError) as error:
        raise TrainingError(f"{file_text} cannot be read ({error}); {advice}.") from error


def _check_value(value: object, expected_type: object, key_path: str) -> None:
    """Raise ValueError, with the path of the key, where a value does not have the expected type."""
    if isinstance(expected_type, tuple):
        if value is not None:
            _check_value(value, expected_type[0], key_path)
    elif isinstance(expected_type, dict):
        if not isinstance(value, dict):
            raise ValueError(f"{key_path or 'it'} is no object")
        for key, key_type in expected_type.items():
            name = key.removesuffix("?")
            if name in value:
                _check_value(value[name], key_type, f"{key_path}.{name}".lstrip("."))
            elif name == key:
                raise ValueError(f"{key_path or 'it'} has no {name}")
    elif isinstance(expected_type, list):
        if not isinstance(value, list):
            raise ValueError(f"{key_path} is no list")
        for index, entry in enumerate(value):
            _check_value(entry, expected_type[0], f"{key_path}[{index}]")
    elif expected_type is Verdict:
        if value not in [verdict.value for verdict in Verdict]:
            raise ValueError(f"{key_path} is no verdict")
    elif expected_type is str:
        if not isinstance(value, str):
            raise ValueError(f"{key_path} is no text")
    elif isinstance(value, bool) or not isinstance(value, int if expected_type is int else int | float):
        raise ValueError(f"{key_path} is no {'whole ' * (expected_type is int)}number")
    elif not -MAX_ABSOLUTE_VALUE <= value <= MAX_ABSOLUTE_VALUE:
        raise ValueError(f"{key_path} is out of all bounds")
