# SPDX-License-Identifier: GPL-3.0-or-later
"""`python tests/windows/run.py [--small] [5.2|4.5 ...]`: run the tests in Python for Windows, under Wine.

`setup/windows/setup` creates the environment for it. Each file of the Blender tier runs in a separate process, because
a crash of Blender must not end the other files. Each other tier runs in one process. The output is in out/windows. A
line for each process has its counts, then come the tests that failed.

Exit status: 0 all tests passed, 1 some tests failed, 2 wrong usage, 3 nothing was run, because with --small Windows is
not set up.
"""

import argparse
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RUN_SCRIPT = ROOT / "setup" / "windows" / "run"
OUTPUT_FOLDER = ROOT / "out" / "windows"
PYTHONS = {"5.2": "3.13", "4.5": "3.11"}
PROCESS_TIMEOUT_SECONDS = 1200
"""Time limit of a process; on an idle machine with 2 cores the longest process takes a third of it."""
NO_TESTS_STATUS = 5
"""Exit status of pytest if a file has no test for this platform."""

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
SMALL = (
    ("tests/core/files/test_output.py", "tests/core/test_recording_writer.py", "tests/core/test_recording_folder.py"),
    ("tests/blender/runtime/test_playback.py", "-k", "strength"),
)
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


def process_arguments(line: str, small: bool) -> list[tuple[str, ...]]:
    """Return the arguments of pytest for each process on an LTS line."""
    if small:
        return list(SMALL)
    blender_files = [(f"tests/blender/{name}",) for name in (BLENDER if line == "5.2" else BLENDER_4_5)]
    tiers = ("tests/core", "tests/contract", "tests/trainer") if line == "5.2" else ("tests/core",)
    return [("tests/windows/acceptance.py",), *blender_files, *((tier,) for tier in tiers)]


def run_process(line: str, arguments: tuple[str, ...]) -> list[str]:
    """Run pytest in the Python of an LTS line, print a line with its counts, and return what failed."""
    log_path = OUTPUT_FOLDER / line / f"{Path(arguments[0]).stem}.log"
    log_path.parent.mkdir(parents=True, exist_ok=True)
    options = ["-q", "-rfE", "--tb=short", "-p", "no:cacheprovider", "-m", "not slow"]
    options += [f"--deselect={test}" for test in FAILURES_OF_WINE]
    limit = ["timeout", "--kill-after=10", str(PROCESS_TIMEOUT_SECONDS)]
    command = [*limit, RUN_SCRIPT, PYTHONS[line], "-m", "pytest", *arguments, *options]
    environment = {**os.environ, "PYTHONUTF8": "1"}
    environment.pop("FDDA_TRAINER_PYTHON", None)  # is a Python of Linux
    start_time = time.monotonic()
    with log_path.open("wb") as log_file:
        status = subprocess.run(
            command, cwd=ROOT, env=environment, stdout=log_file, stderr=log_file, check=False
        ).returncode
    lines = [text for text in log_path.read_text(encoding="utf-8", errors="replace").splitlines() if text]
    print(
        f"{line}  {arguments[0]:<45} {lines[-1] if lines else 'nothing'}  ({time.monotonic() - start_time:.0f} s)",
        flush=True,
    )
    if status in (0, NO_TESTS_STATUS):
        return []
    failed = [text for text in lines if text.startswith(("FAILED ", "ERROR "))]
    return failed or [f"{arguments[0]}: the process ended with status {status}, see {log_path.relative_to(ROOT)}"]


def run_line(line: str, small: bool) -> list[str]:
    """Run all processes of one LTS line, one after the other; return what failed."""
    failed = [text for arguments in process_arguments(line, small) for text in run_process(line, arguments)]
    return [f"{line}: {text}" for text in failed]


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
        failed = [text for each in pool.map(lambda line: run_line(line, options.small), lines) for text in each]
    print("", *failed, *(f"not run: {test}: {reason}" for test, reason in FAILURES_OF_WINE.items()), sep="\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
