# SPDX-License-Identifier: GPL-3.0-or-later
"""Seed faults into a copy of the checkout, one at a time, and record which tests catch each (`make faults`).

`seeded_faults.toml` lists the faults. Exit status 1 where a fault is not caught.
"""

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "benchmarks" / "seeded_faults.toml"
MAX_SECONDS = 400
"""Time limit of one test run. A run that exceeds it is killed and counts as hung."""
TESTS_FAILED = 1
"""Exit status of pytest when a test failed. With any other status but 0, pytest did not run all tests."""
FAILED_TEST = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)
CRASHED, HUNG = "the process ended", "the process hung"


@dataclass(frozen=True)
class Fault:
    """A fault to seed.

    Attributes:
        id: unique.
        kind: short description of the fault.
        file: path in the repository.
        old: text that occurs exactly once in the file.
        new: the text that replaces it.
        tests: paths of test files that catch it.
    """

    id: str
    kind: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def applied(self, text: str) -> str:
        """Seed the fault into the text of its file.

        Raises:
            ValueError: `old` does not occur exactly once.
        """
        if text.count(self.old) != 1:
            raise ValueError(f"{self.id}: {self.old!r} occurs {text.count(self.old)} times in {self.file}")
        return text.replace(self.old, self.new)


@dataclass(frozen=True)
class Outcome:
    """Result of the tests with one fault.

    Attributes:
        id, kind, file: of the fault.
        caught: whether a test failed.
        test: the first test that failed, or `CRASHED` or `HUNG`; empty where none failed.
        seconds: duration of the test processes.
    """

    id: str
    kind: str
    file: str
    caught: bool
    test: str
    seconds: float


def read_faults(path: Path = TABLE) -> list[Fault]:
    """Read the table of faults."""
    rows = tomllib.loads(path.read_text(encoding="utf-8"))["fault"]
    return [Fault(**{**row, "tests": tuple(row["tests"])}) for row in rows]


def copy_checkout(folder: Path) -> None:
    """Copy the tracked files of the checkout into a folder and link its environment."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    for name in filter(None, listed.decode().split("\0")):
        if not (ROOT / name).is_file():
            continue  # A file that was deleted is tracked until the commit.
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target)
    (folder / ".venv").symlink_to((ROOT / ".venv").resolve())
    (folder / "out").mkdir()


def first_failure(folder: Path, tests: Sequence[str]) -> str:
    """Run test files until a test fails.

    Returns:
        The first test that failed, or `CRASHED` or `HUNG`; empty where all passed.

    Raises:
        ValueError: pytest could not run the tests.
    """
    python = folder / ".venv" / "bin" / "python"
    command = [str(python), "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", "not slow", *tests]
    command.append(f"--basetemp={folder / 'out' / 'tests'}")
    environment = {
        **os.environ,
        # Python compares the size of a source file, and its time in whole seconds, to decide whether its byte code is
        # current. A fault may change neither.
        "PYTHONDONTWRITEBYTECODE": "1",
        "FDDA_TRAINER_PYTHON": str(python),
        # With the name of a pytest-xdist worker, the Blender tests reuse the elbow that the run without a fault made.
        "PYTEST_XDIST_WORKER": "gw0",
    }
    status, output = run_command(command, folder, environment, MAX_SECONDS)
    if status is None:
        return HUNG
    if status == 0:
        return ""
    if failed_test := FAILED_TEST.search(output):
        return failed_test.group(1)
    if status > TESTS_FAILED:
        raise ValueError(f"pytest ended with status {status}: {output[-2000:]}")
    return CRASHED


def run_command(
    command: Sequence[str], folder: Path, environment: dict[str, str], max_seconds: float
) -> tuple[int | None, str]:
    """Run a command in a session of its own; at the timeout, kill it with all processes of the session.

    Returns:
        The exit status, None at the timeout; and the output with the errors.
    """
    process = subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=max_seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return None, ""
    return process.returncode, output


def seed_and_test(fault: Fault, folder: Path, run_tiers: bool) -> Outcome:
    """Seed one fault, run its tests and restore the file."""
    file, started = folder / fault.file, time.perf_counter()
    text = file.read_text(encoding="utf-8")
    file.write_text(fault.applied(text), encoding="utf-8")
    try:
        test = first_failure(folder, fault.tests)
        if not test and run_tiers:
            test = first_failure(folder, sorted({str(Path(name).parent) for name in fault.tests}))
    finally:
        file.write_text(text, encoding="utf-8")
    return Outcome(fault.id, fault.kind, fault.file, bool(test), test, round(time.perf_counter() - started, 1))


def format_table(outcomes: Sequence[Outcome]) -> str:
    """Format a table with one row per fault."""
    lines = ["| fault | kind | caught by | s |", "|---|---|---|---|"]
    for outcome in outcomes:
        tests = f"`{outcome.test.partition('::')[0]}`" if "::" in outcome.test else outcome.test or "**no test**"
        lines.append(f"| `{outcome.id}` | {outcome.kind} | {tests} | {outcome.seconds:.0f} |")
    return "\n".join(lines)


def main() -> int:
    """Seed the faults; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder of faults.json")
    parser.add_argument("--only", nargs="+", metavar="ID", help="seed only these faults")
    parser.add_argument("--all-tests", action="store_true", help="where the named files catch nothing, run their tiers")
    options = parser.parse_args()
    faults = read_faults()
    if unknown := set(options.only or ()) - {fault.id for fault in faults}:
        parser.error(f"there is no fault {', '.join(sorted(unknown))}")
    faults = [fault for fault in faults if not options.only or fault.id in options.only]
    options.out.mkdir(parents=True, exist_ok=True)
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="seeded-") as temporary:
        folder = Path(temporary)
        copy_checkout(folder)
        if test := first_failure(folder, sorted({test for fault in faults for test in fault.tests})):
            print(f"Without any fault, {test} fails.")
            return 1
        for fault in faults:
            outcomes.append(seed_and_test(fault, folder, options.all_tests))
            row = outcomes[-1]
            print(f"{row.id}: {row.test or 'NOT CAUGHT'}, {row.seconds:.0f} s", file=sys.stderr, flush=True)
            text = json.dumps([asdict(outcome) for outcome in outcomes], indent=1)
            (options.out / "faults.json").write_text(text + "\n", encoding="utf-8")
    print(format_table(outcomes))
    missed = [outcome.id for outcome in outcomes if not outcome.caught]
    print(f"{len(outcomes)} faults, {len(missed)} not caught{': ' if missed else ''}{', '.join(missed)}")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
