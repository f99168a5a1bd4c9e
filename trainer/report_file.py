# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks what a page is made of, which may be from anyone: a report, and the JSON that `evaluate` writes.

`core.report` sees to it that what the page shows as a number is a number: only text, which the page escapes, could hold
a tag. Here is what else has to be true of the numbers, so that they can be drawn.
"""

import json
import math
from itertools import pairwise
from pathlib import Path

from fdda_addon.core.errors import TrainingError, os_error_text
from fdda_addon.core.input_file import read_input

from .charts import SMALLEST

MAX_BYTES = 256 << 20
LARGEST = 1e12
STATISTICS = ("mean", "rms", "p99", "p999", "max")


def check_drawable(report: dict, path: Path) -> None:
    """Fail where the numbers of a report, all of them numbers, cannot be drawn.

    Args:
        report: what `core.report.read_report` gave.
        path: of it.

    Raises:
        TrainingError: says what is wrong with them.
    """
    histogram = report["histogram"]
    edges, counts = histogram["edges"], (histogram["fdda"], histogram["linear"])
    problems = {
        "it has no partitions": not report["partitions"],
        "its histogram has not as many counts as edges": not all(len(edges) == len(own) + 1 > 3 for own in counts),
        "its histogram counts nothing": not all(min(own, default=0) >= 0 and any(own) for own in counts),
        "the edges of its histogram do not ascend": not all(low < high for low, high in pairwise(edges))
        or not all(SMALLEST <= edge <= LARGEST for edge in edges[1:]),
        "a curve is empty": any(
            bool(p["curve"]["training"]) != bool(p["curve"]["validation"]) for p in report["partitions"]
        ),
        "it has normals without edges": bool(report.get("normals")) and not report.get("edges"),
    }
    if found := [problem for problem, is_there in problems.items() if is_there]:
        raise TrainingError(f"The report '{path}' is damaged: {found[0]}; train again.")


def read_evaluation(path: Path) -> dict:
    """Read what `evaluate --json` wrote, as far as the page shows it.

    Raises:
        TrainingError: it is something else, or damaged.
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
        numbers = [evaluation["poses"], *(evaluation[way][name] for way in ("fdda", "linear") for name in STATISTICS)]
    except (KeyError, TypeError) as error:
        raise TrainingError(f"The evaluation '{path}' is damaged: it lacks its errors; evaluate again.") from error
    if not all(type(number) in (int, float) and math.isfinite(float(number)) for number in numbers):
        raise TrainingError(f"The evaluation '{path}' is damaged: its errors are no numbers; evaluate again.")
    return evaluation
