# SPDX-License-Identifier: GPL-3.0-or-later
"""`python tests/windows/run.py [--small] [5.2|4.5 ...]`: run tests in Python for Windows, under Wine.

`setup/windows/setup` makes what this needs. Each file of the Blender tier runs in a process of its own: one that ends
Blender does not end the others. The other tiers run in a process each. Their output goes to out/windows. The last lines
are the counts of each tier and the tests that failed.

Exit status: 0 all passed, 1 some did not, 2 wrong usage, 3 with --small: Windows is not set up, nothing was run.
"""

import argparse
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[2]
RUN = ROOT / "setup" / "windows" / "run"
OUT = ROOT / "out" / "windows"
PYTHONS = {"5.2": "3.13", "4.5": "3.11"}
SECONDS = 1200
"""What a process may take; on a quiet machine with 2 cores the longest takes a third of it."""
NO_TESTS = 5
"""The exit status of pytest where no test is for this platform."""
OUTCOMES = {"error": "failed", "failure": "failed", "skipped": "skipped"}
"""What a test has in a report of pytest's, and the word for it here; one without any has passed."""

# Of the Blender tier: writing, training, playing and rendering. The others show nothing more about Windows.
BLENDER = (
    "recording",
    "overwriting",
    "shards",
    "baked_files",
    "encodings",
    "documents",
    "command_process",
    "background_jobs",
    "trainer_environment",
    "trainer_python",
    "detached_trainings",
    "refinement",
    "packed_by_default",
    "playback",
    "playback_of_edits",
    "playing_state",
    "animated_mode",
    "linked_files",
    "extension",
    "renders",
    "render_evaluations",
)
BLENDER_4_5 = (
    "recording", "command_process", "playback", "playback_of_edits", "linked_files", "extension", "renders",
)  # fmt: skip
SMALL = {
    "core": ("tests/core/test_output.py", "tests/core/test_recording_writer.py", "tests/core/test_recording_lock.py"),
    "blender": ("tests/blender/test_playback.py", "-k", "strength"),
}
"""Core files that write; and a test whose fixture records, trains and binds."""

IS_CURRENT = """
import runpy, sys
sys.argv[1:] = ["is-current", sys.prefix, "everything"]
runpy.run_path("setup/environment.py", run_name="__main__")
"""

# What fails because of Wine, with the reason. On Windows these should pass.
_CTRL_BREAK = "Wine does not send Ctrl-Break to the group of another process."
OF_WINE: dict[str, str] = {
    "tests/blender/test_command_process.py::test_an_interrupted_recording_resumes": _CTRL_BREAK,
    "tests/blender/test_command_process.py::test_an_interrupted_training_leaves_neither_model_nor_trainer": _CTRL_BREAK,
}


@dataclass(frozen=True)
class Result:
    """What a process of pytest came to."""

    line: str
    tier: str
    counts: Counter
    failed: tuple[str, ...]


def parts(line: str, small: bool) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the tier and the arguments of pytest for each process on an LTS line."""
    if small:
        yield from SMALL.items()
        return
    yield "acceptance", ("tests/windows/acceptance.py",)
    for name in BLENDER if line == "5.2" else BLENDER_4_5:
        yield "blender", (f"tests/blender/test_{name}.py",)
    yield "core", ("tests/core",)
    if line == "5.2":
        yield "contract", ("tests/contract",)
        yield "trainer", ("tests/trainer",)


def run(line: str, tier: str, arguments: tuple[str, ...]) -> Result:
    """Run pytest in the Python of `line` and print a line about it."""
    log = OUT / line / f"{Path(arguments[0]).stem}.log"
    report = log.with_suffix(".xml")
    log.parent.mkdir(parents=True, exist_ok=True)
    report.unlink(missing_ok=True)
    options = ["-q", "--tb=short", "-p", "no:cacheprovider", "-m", "not slow"]
    options += [f"--junit-xml={report.relative_to(ROOT)}", *(f"--deselect={test}" for test in OF_WINE)]
    command = ["timeout", "--kill-after=10", str(SECONDS), RUN, PYTHONS[line], "-m", "pytest", *arguments, *options]
    environment = {**os.environ, "PYTHONUTF8": "1"}
    environment.pop("FDDA_TRAINER_PYTHON", None)  # that of Linux
    begin = time.monotonic()
    with log.open("wb") as file:
        status = subprocess.run(command, cwd=ROOT, env=environment, stdout=file, stderr=file, check=False).returncode
    counts, failed = outcome(report) if report.is_file() else (Counter(), ())
    if status not in (0, NO_TESTS) and not failed:
        counts["failed"] += 1
        failed = (f"{arguments[0]}: the process ended with status {status}, see {log.relative_to(ROOT)}",)
    told = ", ".join(f"{number} {word}" for word, number in counts.items()) or "nothing"
    print(f"{line}  {arguments[0]:<45} {told}  ({time.monotonic() - begin:.0f} s)", flush=True)
    return Result(line, tier, counts, failed)


def outcome(report: Path) -> tuple[Counter, tuple[str, ...]]:
    """Return the counts by outcome in a report of pytest's, and the names of the tests that failed."""
    counts, failed = Counter(), []
    for case in ElementTree.parse(report).iter("testcase"):
        found = {child.tag for child in case}
        word = next((word for tag, word in OUTCOMES.items() if tag in found), "passed")
        counts[word] += 1
        if word == "failed":
            failed.append(f"{case.get('classname')}::{case.get('name')}")
    return counts, tuple(failed)


def run_line(line: str, small: bool) -> list[Result]:
    """Run all parts on one LTS line, one after the other."""
    return [run(line, tier, arguments) for tier, arguments in parts(line, small)]


def print_summary(results: list[Result]) -> None:
    """Print the counts of each tier, then the tests that failed and those that Wine cannot run."""
    tiers: dict[tuple[str, str], Counter] = {}
    for result in results:
        tiers.setdefault((result.line, result.tier), Counter()).update(result.counts)
    print()
    for (line, tier), counts in sorted(tiers.items(), reverse=True):
        print(f"{line}  {tier:<12} {', '.join(f'{number} {word}' for word, number in counts.items())}")
    for result in results:
        for test in result.failed:
            print(f"failed on {result.line}: {test}")
    for test, reason in OF_WINE.items():
        print(f"not run: {test}: {reason}")


def is_set_up(line: str) -> bool:
    """Whether setup/windows/setup has finished for `line`, with the pins of this tree."""
    return not subprocess.run([RUN, PYTHONS[line], "-c", IS_CURRENT], cwd=ROOT, capture_output=True).returncode


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--small", action="store_true", help="core files that write, a recording, a training, a bind")
    parser.add_argument("lines", nargs="*", metavar="LINE", help="5.2 or 4.5; when left out both, with --small 5.2")
    options = parser.parse_args()
    lines = options.lines or (["5.2"] if options.small else list(PYTHONS))
    if unknown := set(lines) - set(PYTHONS):
        parser.error(f"LINE is 5.2 or 4.5, not {min(unknown)}")
    if options.small and not all(map(is_set_up, lines)):
        print("Windows is not tested: it is not set up here, or with other requirements; make test-windows does both.")
        return 3
    # The lines have a Wine each, and run side by side.
    with ThreadPoolExecutor() as pool:
        results = [result for each in pool.map(lambda line: run_line(line, options.small), lines) for result in each]
    print_summary(results)
    return 1 if any(result.failed for result in results) else 0


if __name__ == "__main__":
    sys.exit(main())
