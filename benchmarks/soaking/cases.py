# SPDX-License-Identifier: GPL-3.0-or-later
"""Cases of the soak test: run one, measure its time and memory, and pass its result to the parent process."""

import contextlib
import json
import os
import re
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from fdda_addon.core.errors import FDDAError

REFUSED, PASSED, FAILED = "refused", "passed", "failed"
MARK = "soak: "
"""Beginning of an output line that holds the JSON of a case."""
MAX_SENTENCE_CHARACTERS = 1500
MAX_MB = 1024
"""Limit of the peak memory of a case, above the memory that the process used before."""
MAX_SECONDS = 30


class CaseFailedError(Exception):
    """The result of a case is wrong; the message says how."""


@dataclass
class Case:
    """Result of one case.

    Attributes:
        part, name: part of the soak test, and name of the case.
        outcome: `REFUSED`, `PASSED` or `FAILED`.
        text: the error message of a refused case, or the reason of a failed one.
        seconds: duration.
        peak_mb: peak memory above the memory that the process used before.
        memory_mb: memory of the process afterwards.
        error_m: largest distance between a shown and an expected position, meters.
    """

    part: str
    name: str
    outcome: str
    text: str
    seconds: float
    peak_mb: float
    memory_mb: float
    error_m: float = 0.0


def run_case(part: str, name: str, action: Callable[[], float | None]) -> Case:
    """Run an action that must either work or be refused with an error message; return its case."""
    started, memory_before_mb = time.perf_counter(), _reset_peak()
    error_m = 0.0
    try:
        error_m = action() or 0.0
        outcome, text = PASSED, ""
    except FDDAError as error:
        text = str(error)
        outcome = REFUSED if is_sentence(text) else FAILED
    except CaseFailedError as error:
        outcome, text = FAILED, str(error)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        outcome, text = FAILED, f"{error!r} {traceback.format_exc(limit=-3)}"
    seconds, peak_mb = time.perf_counter() - started, _peak_mb() - memory_before_mb
    if outcome != FAILED and (peak_mb > MAX_MB or seconds > MAX_SECONDS):
        outcome, text = FAILED, f"it took {peak_mb:.0f} MB and {seconds:.0f} s; {text}"
    return Case(part, name, outcome, text, seconds, peak_mb, memory_mb(), error_m)


def is_sentence(text: str) -> bool:
    """Return whether a text is one line of limited length, without control characters, that ends like a sentence."""
    return len(text) <= MAX_SENTENCE_CHARACTERS and re.fullmatch(r"[^\x00-\x1f\x7f]+[.)]", text) is not None


def print_case(case: Case) -> None:
    """Print a case as a line for the parent process."""
    print(MARK + json.dumps(asdict(case)), flush=True)


def parse_case(line: str) -> Case | None:
    """Parse a line that `print_case` printed; return None for any other line."""
    return Case(**json.loads(line.removeprefix(MARK))) if line.startswith(MARK) else None


def memory_mb() -> float:
    """Return the memory of this process, MB."""
    return _read_process_status("VmRSS")


def _reset_peak() -> float:
    """Reset the peak memory use of this process, and return its present use, MB."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _read_process_status("VmRSS")


def _peak_mb() -> float:
    return _read_process_status("VmHWM")


def _read_process_status(name: str) -> float:
    """Read a value from /proc/self/status, MB; 0 where the system is not Linux."""
    if not os.path.exists("/proc/self/status"):
        return 0.0
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name)]
    return int(line.split()[1]) / 1024
