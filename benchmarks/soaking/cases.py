# SPDX-License-Identifier: GPL-3.0-or-later
"""One case of a soak: what was done, what came of it, what it took; and how a part tells its parent."""

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

REFUSED, PLAYED, FELL_SHORT = "refused", "held", "fell short"
MARK = "soak: "
"""Before the JSON of a case, on a line of stdout."""
LONGEST_SENTENCE = 1500
MAX_MB = 1024
"""What a refused file may take of memory at its peak."""
MAX_SECONDS = 30


class ShortfallError(Exception):
    """A case did not do what it must; the text says what."""


@dataclass
class Case:
    """One case.

    Attributes:
        part, name: what was done.
        outcome: `REFUSED`, `PLAYED` or `FELL_SHORT`.
        text: the sentence of a refusal, or what fell short.
        seconds: it took.
        peak_mb: of memory at its highest, above what the process had before.
        memory_mb: of memory that the process has afterwards.
        off: largest distance in metres of what was shown from what the model says.
    """

    part: str
    name: str
    outcome: str
    text: str
    seconds: float
    peak_mb: float
    memory_mb: float
    off: float = 0.0


def attempt(part: str, name: str, action: Callable[[], float | None]) -> Case:
    """Do something that holds, or is refused in a sentence; gives the case."""
    started, before = time.perf_counter(), _start_peak()
    off = 0.0
    try:
        off = action() or 0.0
        outcome, text = PLAYED, ""
    except FDDAError as error:
        text = str(error)
        outcome = REFUSED if is_sentence(text) else FELL_SHORT
    except ShortfallError as error:
        outcome, text = FELL_SHORT, str(error)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        outcome, text = FELL_SHORT, f"{error!r} {traceback.format_exc(limit=-3)}"
    seconds, peak = time.perf_counter() - started, _peak_mb() - before
    if outcome != FELL_SHORT and (peak > MAX_MB or seconds > MAX_SECONDS):
        outcome, text = FELL_SHORT, f"it took {peak:.0f} MB and {seconds:.0f} s; {text}"
    return Case(part, name, outcome, text, seconds, peak, memory_mb(), off)


def is_sentence(text: str) -> bool:
    """Whether a text is one line of a readable length that ends as a sentence does, and steers no terminal."""
    return len(text) <= LONGEST_SENTENCE and re.fullmatch(r"[^\x00-\x1f\x7f]+[.)]", text) is not None


def say(case: Case) -> None:
    """Tell the parent."""
    print(MARK + json.dumps(asdict(case)), flush=True)


def heard(line: str) -> Case | None:
    """The case of a line of a part, None for any other line."""
    return Case(**json.loads(line.removeprefix(MARK))) if line.startswith(MARK) else None


def memory_mb() -> float:
    """What the process holds in memory now."""
    return _status("VmRSS")


def _start_peak() -> float:
    """Measure the peak of memory from now on; gives what is held now."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def _peak_mb() -> float:
    return _status("VmHWM")


def _status(name: str) -> float:
    if not os.path.exists("/proc/self/status"):
        return 0.0
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name)]
    return int(line.split()[1]) / 1024
