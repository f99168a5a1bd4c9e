# SPDX-License-Identifier: GPL-3.0-or-later
"""`python tests/windows/run.py [--small] [5.2|4.5 ...]`: run the tests in Python for Windows, under Wine.

`setup/windows/setup` creates the environment for it. Each file of the Blender tier runs in a separate process, because
a crash of Blender must not end the other files. Each other tier runs in one process. The output is in out/windows. The
last lines are the counts of each tier and the tests that failed.

Exit status: 0 all tests passed, 1 some tests failed, 2 wrong usage, 3 nothing was run, because with --small Windows is
not set up.
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
RUN_SCRIPT = ROOT / "setup" / "windows" / "run"
OUTPUT_FOLDER = ROOT / "out" / "windows"
PYTHONS = {"5.2": "3.13", "4.5": "3.11"}
PROCESS_TIMEOUT_SECONDS = 1200
"""Time limit of a process; on an idle machine with 2 cores the longest process takes a third of it."""
NO_TESTS_STATUS = 5
"""Exit status of pytest if a file has no test for this platform."""
OUTCOME_BY_TAG = {"error": "failed", "failure": "failed", "skipped": "skipped"}
"""Outcome of a test by its XML tag in the report of pytest; a test without these tags has passed."""

# Of the Blender tier: writing, training, playing and rendering. The others show nothing more about Windows.
BLENDER = (
    "test_recording.py",
    "cli/test_overwriting.py",
    "baking/test_baking.py",
    "cli/test_documents.py",
    "cli/test_command_process.py",
    "operators/test_job.py",
    "training/test_trainer_environment.py",
    "training/test_trainings.py",
    "test_refinement.py",
    "runtime/test_packed_models.py",
    "runtime/test_playback.py",
    "runtime/test_playing_state.py",
    "runtime/test_modes.py",
    "runtime/test_linked_characters.py",
    "extension/test_extension.py",
    "runtime/test_renders.py",
)
BLENDER_4_5 = (
    "test_recording.py",
    "cli/test_command_process.py",
    "runtime/test_playback.py",
    "runtime/test_linked_characters.py",
    "extension/test_extension.py",
    "runtime/test_renders.py",
)
SMALL = {
    "core": (
        "tests/core/files/test_output.py",
        "tests/core/test_recording_writer.py",
        "tests/core/test_recording_folder.py",
    ),
    "blender": ("tests/blender/runtime/test_playback.py", "-k", "strength"),
}
"""Core files that write; and a test whose fixture records, trains and binds."""

IS_CURRENT = """
import runpy, sys
sys.argv[1:] = ["is-current", sys.prefix, "everything"]
runpy.run_path("setup/environment.py", run_name="__main__")
"""

# Tests that fail because of Wine, with the reason. They should pass on Windows.
_CTRL_BREAK = "Wine does not send Ctrl-Break to the group of another process."
FAILURES_OF_WINE: dict[str, str] = {
    f"tests/blender/cli/test_command_process.py::test_{test}": _CTRL_BREAK
    for test in ("a_stopped_recording_resumes[False]", "an_interrupted_training_leaves_neither_model_nor_trainer")
}


@dataclass(frozen=True)
class ProcessResult:
    """The outcome of one process of pytest.

    Attributes:
        line: LTS line of Blender.
        tier: name of the tier.
        counts: numbers of tests by outcome.
        failed: names of the tests that failed.
    """

    line: str
    tier: str
    counts: Counter
    failed: tuple[str, ...]


def process_arguments(line: str, small: bool) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the tier and the arguments of pytest for each process on an LTS line."""
    if small:
        yield from SMALL.items()
        return
    yield "acceptance", ("tests/windows/acceptance.py",)
    for name in BLENDER if line == "5.2" else BLENDER_4_5:
        yield "blender", (f"tests/blender/{name}",)
    yield "core", ("tests/core",)
    if line == "5.2":
        yield "contract", ("tests/contract",)
        yield "trainer", ("tests/trainer",)


def run_process(line: str, tier: str, arguments: tuple[str, ...]) -> ProcessResult:
    """Run pytest in the Python of an LTS line and print a line with the counts."""
    log_path = OUTPUT_FOLDER / line / f"{Path(arguments[0]).stem}.log"
    report_path = log_path.with_suffix(".xml")
    log_path.parent.mkdir(parents=True, exist_ok=True)
    report_path.unlink(missing_ok=True)
    options = ["-q", "--tb=short", "-p", "no:cacheprovider", "-m", "not slow"]
    options += [f"--junit-xml={report_path.relative_to(ROOT)}", *(f"--deselect={test}" for test in FAILURES_OF_WINE)]
    command = [
        "timeout",
        "--kill-after=10",
        str(PROCESS_TIMEOUT_SECONDS),
        RUN_SCRIPT,
        PYTHONS[line],
        "-m",
        "pytest",
        *arguments,
        *options,
    ]
    environment = {**os.environ, "PYTHONUTF8": "1"}
    environment.pop("FDDA_TRAINER_PYTHON", None)  # is a Python of Linux
    start_time = time.monotonic()
    with log_path.open("wb") as log_file:
        status = subprocess.run(
            command, cwd=ROOT, env=environment, stdout=log_file, stderr=log_file, check=False
        ).returncode
    counts, failed = read_outcomes(report_path) if report_path.is_file() else (Counter(), ())
    if status not in (0, NO_TESTS_STATUS) and not failed:
        counts["failed"] += 1
        failed = (f"{arguments[0]}: the process ended with status {status}, see {log_path.relative_to(ROOT)}",)
    summary = ", ".join(f"{number} {word}" for word, number in counts.items()) or "nothing"
    print(f"{line}  {arguments[0]:<45} {summary}  ({time.monotonic() - start_time:.0f} s)", flush=True)
    return ProcessResult(line, tier, counts, failed)


def read_outcomes(report_path: Path) -> tuple[Counter, tuple[str, ...]]:
    """Return the counts by outcome in a report of pytest's, and the names of the tests that failed."""
    counts, failed = Counter(), []
    for case in ElementTree.parse(report_path).iter("testcase"):
        tags = {child.tag for child in case}
        outcome = next((outcome for tag, outcome in OUTCOME_BY_TAG.items() if tag in tags), "passed")
        counts[outcome] += 1
        if outcome == "failed":
            failed.append(f"{case.get('classname')}::{case.get('name')}")
    return counts, tuple(failed)


def run_line(line: str, small: bool) -> list[ProcessResult]:
    """Run all processes of one LTS line, one after the other."""
    return [run_process(line, tier, arguments) for tier, arguments in process_arguments(line, small)]


def print_summary(results: list[ProcessResult]) -> None:
    """Print the counts of each tier, then the tests that failed and the tests that Wine cannot run."""
    counts_by_tier: dict[tuple[str, str], Counter] = {}
    for result in results:
        counts_by_tier.setdefault((result.line, result.tier), Counter()).update(result.counts)
    print()
    for (line, tier), counts in sorted(counts_by_tier.items(), reverse=True):
        print(f"{line}  {tier:<12} {', '.join(f'{number} {word}' for word, number in counts.items())}")
    for result in results:
        for test in result.failed:
            print(f"failed on {result.line}: {test}")
    for test, reason in FAILURES_OF_WINE.items():
        print(f"not run: {test}: {reason}")


def is_set_up(line: str) -> bool:
    """Return whether setup/windows/setup has finished for an LTS line, with the requirements of this working tree."""
    return not subprocess.run([RUN_SCRIPT, PYTHONS[line], "-c", IS_CURRENT], cwd=ROOT, capture_output=True).returncode


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
    # Each line has its own Wine, so the lines run in parallel.
    with ThreadPoolExecutor() as pool:
        results = [result for each in pool.map(lambda line: run_line(line, options.small), lines) for result in each]
    print_summary(results)
    return 1 if any(result.failed for result in results) else 0


if __name__ == "__main__":
    sys.exit(main())
