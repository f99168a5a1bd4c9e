# SPDX-License-Identifier: GPL-3.0-or-later
"""The report of a training, `report.json` beside its model (docs/formats.md): its keys, reading and writing.

The trainer writes it; its page and the sidebar show it.
"""

import enum
import json
from pathlib import Path

from .errors import TrainingError, os_error_text
from .input_file import read_input
from .output import to_json_text, write_text

REPORT_JSON, REPORT_HTML = "report.json", "report.html"
CHECKPOINT_SUFFIX = ".checkpoint.npz"
FORMAT, VERSION = "fdda-report", 1
MAX_BYTES = 1 << 27
"""Fifty times the size of a report of 100 partitions and 1000 epochs."""
MAX_ABSOLUTE_VALUE = 1e300
"""Largest absolute value of a number in a report."""


class Verdict(enum.Enum):
    """How a training meets its accuracy goal."""

    MET = "met"
    MISSED = "missed"
    """More poses may help."""
    EXHAUSTED = "exhausted"
    """More poses no longer help."""


class _OrNull:
    def __init__(self, kind: object):
        self.kind = kind


_ERRORS = dict.fromkeys(("mean", "rms", "p99", "p999", "max"), float)
_ANGLES = dict.fromkeys(("mean", "p99", "max"), float)
_EDGE_ERRORS = dict.fromkeys(("inside", "beside", "across"), _OrNull(float))
_PARTITION = {
    "joint": str,
    "vertices": int,
    "influencing": [str],
    "controls?": [str],
    "merged?": [str],
    "features": int,
    "basis": int,
    "truncation": float,
    "training": _ERRORS,
    "held_out": _ERRORS,
    "linear": _ERRORS,
    "histogram": [int],
    "largest_errors": {
        "poses": int,
        "vertices": int,
        "truncation": float,
        "boundary": _OrNull(float),
        "joint": str,
        "extreme": float,
        "distance": float,
        "generalization": float,
        "cause": str,
    },
    "curve": {"training": [float], "validation": [float], "worst": [float], "best_epoch": int},
}
_REPORT = {
    "unit": str,
    "model": str,
    "model_bytes": int,
    "recording": str,
    "object": str,
    "vertices": int,
    "joints": int,
    "controls?": [str],
    "poses": int,
    "training": {"seconds": float, "device": str, "epochs": int, "training_poses": int, "held_out_poses": int},
    "parity": float,
    "constant_bytes?": int,
    "fdda": {"training": _ERRORS, "held_out": _ERRORS},
    "linear": {"held_out": _ERRORS},
    "normals?": _OrNull({"fdda": _ANGLES, "linear": _ANGLES}),
    "edges?": _OrNull({"fdda": _EDGE_ERRORS, "linear": _EDGE_ERRORS}),
    "histogram": {"edges": [float], "fdda": [int], "linear": [int]},
    "partitions": [_PARTITION],
    "warnings?": [{"name": str, "text": str}],
    "repeatability?": {"poses": [int], "distance_mm": _ERRORS, "linear_mm": float},
    "goal?": {"goal": float, "p999": float, "verdict": Verdict},
}
"""Keys and types of their values; `?` marks an optional key, and further keys are permitted."""


def report_path(model: Path) -> Path:
    """Return the path of a model's report."""
    return model.with_name(REPORT_JSON)


def page_path(model: Path) -> Path:
    """Return the path of the page of a model's report."""
    return model.with_name(REPORT_HTML)


def checkpoint_path(model: Path) -> Path:
    """Return the path of a model's checkpoint, from which a training continues."""
    return model.with_suffix(CHECKPOINT_SUFFIX)


def write_report(path: Path, report: dict) -> None:
    """Write a report with `format` and `version`.

    Raises:
        ValueError: it is not what `read_report` takes; a bug.
        OutputError: it cannot be written.
    """
    write_text(path, report_text(report))


def report_text(report: dict) -> str:
    """Return the text that `write_report` writes; raises its ValueError."""
    _check_value(report, _REPORT, "")
    return to_json_text({"format": FORMAT, "version": VERSION, **report})


def read_report(path: Path) -> dict:
    """Read a report.

    Returns:
        It, with all keys of docs/formats.md and values of their kinds.

    Raises:
        TrainingError: it cannot be read, is of another version, or damaged.
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
        _check_value(report, _REPORT, "")
    except ValueError as error:
        raise TrainingError(f"The report '{path}' is damaged: {error}; train again.") from error
    return report


def _check_value(value: object, kind: object, key_path: str) -> None:
    """Raise ValueError, with the path of the key, where a value is not of its kind."""
    if isinstance(kind, _OrNull):
        if value is not None:
            _check_value(value, kind.kind, key_path)
    elif isinstance(kind, dict):
        if not isinstance(value, dict):
            raise ValueError(f"{key_path or 'it'} is no object")
        for key, value_kind in kind.items():
            name = key.removesuffix("?")
            if name in value:
                _check_value(value[name], value_kind, f"{key_path}.{name}".lstrip("."))
            elif name == key:
                raise ValueError(f"{key_path or 'it'} has no {name}")
    elif isinstance(kind, list):
        if not isinstance(value, list):
            raise ValueError(f"{key_path} is no list")
        for number, entry in enumerate(value):
            _check_value(entry, kind[0], f"{key_path}[{number}]")
    elif kind is Verdict:
        if value not in [verdict.value for verdict in Verdict]:
            raise ValueError(f"{key_path} is no verdict")
    elif kind is str:
        if not isinstance(value, str):
            raise ValueError(f"{key_path} is no text")
    elif isinstance(value, bool) or not isinstance(value, int if kind is int else int | float):
        raise ValueError(f"{key_path} is no {'whole ' * (kind is int)}number")
    elif not -MAX_ABSOLUTE_VALUE <= value <= MAX_ABSOLUTE_VALUE:
        raise ValueError(f"{key_path} is out of all bounds")
