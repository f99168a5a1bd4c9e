# SPDX-License-Identifier: GPL-3.0-or-later
"""Validates the files that a report page is made from: a report, and the JSON that `evaluate` writes.

The files may be damaged or hostile. `core.report` checks the types, so that only text, which the page escapes, can hold
HTML. This module checks that the numbers can be drawn.
"""

import json
import math
from itertools import pairwise
from pathlib import Path

from fdda_addon.core.errors import TrainingError, os_error_text
from fdda_addon.core.input_file import read_input

from .charts import MIN_AXIS_MM
from .page import STATISTIC_LABELS

MAX_BYTES = 256 << 20
MAX_EDGE_MM = 1e12
"""Maximum bin edge of the histogram, mm."""


def check_drawable(report: dict, path: Path) -> None:
    """Check that the numbers of a report can be drawn.

    Args:
        report: as from `core.report.read_report`.
        path: path of the report, for the message.

    Raises:
        TrainingError: the numbers cannot be drawn.
    """
    histogram = report["histogram"]
    edges, counts = histogram["edges"], (histogram["fdda"], histogram["linear"])
    problems = {
        "it has no partitions": not report["partitions"],
        "its histogram has not as many counts as edges": not all(
            len(edges) == len(bin_counts) + 1 > 3 for bin_counts in counts
        ),
        "its histogram counts nothing": not all(
            min(bin_counts, default=0) >= 0 and any(bin_counts) for bin_counts in counts
        ),
        "the edges of its histogram do not ascend": not all(low < high for low, high in pairwise(edges))
        or not all(MIN_AXIS_MM <= edge <= MAX_EDGE_MM for edge in edges[1:]),
        "a curve is empty": any(
            bool(partition["curve"]["training"]) != bool(partition["curve"]["validation"])
            for partition in report["partitions"]
        ),
        "it has normals without edges": bool(report.get("normals")) and not report.get("edges"),
    }
    if found_problems := [problem for problem, is_present in problems.items() if is_present]:
        raise TrainingError(f"The report '{path}' is damaged: {found_problems[0]}; train again.")


def read_evaluation(path: Path) -> dict:
    """Read the JSON that `evaluate` wrote, and check the values that the page shows.

    Raises:
        TrainingError: the file is damaged, or of another kind.
    """
    try:
        evaluation = json.loads(read_input(path, MAX_BYTES))
    except OSError as error:
        raise TrainingError(
            f"The evaluation '{path}' cannot be read ({os_error_text(error)}); evaluate again."
        ) from error
    except (ValueError, RecursionError) as error:
        raise TrainingError(f"The evaluation '{path}' cannot be read ({error}); evaluate again.") from error
    try:
        statistics = (evaluation[method][name] for method in ("fdda", "linear") for name in STATISTIC_LABELS)
        numbers = [evaluation["poses"], *statistics]
    except (KeyError, TypeError) as error:
        raise TrainingError(f"The evaluation '{path}' is damaged: it lacks its errors; evaluate again.") from error
    if not all(type(number) in (int, float) and math.isfinite(float(number)) for number in numbers):
        raise TrainingError(f"The evaluation '{path}' is damaged: its errors are no numbers; evaluate again.")
    return evaluation
