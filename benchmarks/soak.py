# SPDX-License-Identifier: GPL-3.0-or-later
"""Test the add-on with many damaged files, killed processes and full disks, and count the cases that fail:

    python benchmarks/soak.py out/soak [--seed 1] [--part NAME ...] [--scale 1.0]

Each part runs in separate processes. A process that dies is counted as a crash, a process that prints nothing for more
than 30 seconds as a hang; the part then continues with the next case. The seed alone determines the cases. The exit
status is 1 where a case failed. Each case is a line of out/soak/cases.jsonl.
"""

import argparse
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.soaking.cases import FAILED, PASSED, REFUSED, Case, parse_case  # noqa: E402

CASE_TIMEOUT_SECONDS = 30
START_TIMEOUT_SECONDS = 120
"""Time limit of the first case, which includes loading Blender and torch."""
MAX_GROWTH_MB = 60
"""How much the memory of a process may grow during the second half of a part."""
MAX_SHOWN_CASES = 12


@dataclass(frozen=True)
class SoakPart:
    """A part of the soak test: its name, its number of cases, and how many cases one process runs."""

    name: str
    count: int
    cases_per_process: int


DISKS = "disks"
SOAK_PARTS = (
    SoakPart("models", 3000, 750),
    SoakPart("recordings", 2000, 500),
    SoakPart("kills", 45, 45),
    SoakPart(DISKS, 40, 40),
)


def select_parts(names: Sequence[str] | None) -> list[SoakPart]:
    """Return the parts of these names, or all parts that this user can run."""
    if names:
        return [part for part in SOAK_PARTS if part.name in names]
    if os.geteuid() == 0:
        return list(SOAK_PARTS)
    print(f"{DISKS}: left out, only root can mount a disk", flush=True)
    return [part for part in SOAK_PARTS if part.name != DISKS]


def run_part(part: str, folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Run cases of a part in this process, which then ends."""
    if part == "recordings":
        from benchmarks.soaking.recordings import run
    elif part == "models":
        from benchmarks.soaking.models import run
    else:
        from benchmarks.soaking import interruptions

        run = interruptions.run_kills if part == "kills" else interruptions.run_full_disks
    run(folder, seed, first_case, end_case)
    sys.stdout.flush()
    # Blender's own shutdown is not part of the test.
    os._exit(0)


def watch_part(part: SoakPart, folder: Path, seed: int, add_case: Callable[[Case], None]) -> None:
    """Run a part, process by process; a crash or a hang is added as a failed case."""
    case_index = 0
    while case_index < part.count:
        end_case = min(case_index + part.cases_per_process, part.count)
        work = (str(folder), "--seed", str(seed), "--work", part.name, str(case_index), str(end_case))
        with open(folder / f"{part.name}.log", "a", encoding="utf-8") as log:
            process = subprocess.Popen(
                [sys.executable, __file__, *work], stdout=subprocess.PIPE, stderr=log, text=True, errors="replace"
            )
            lines: queue.Queue[str] = queue.Queue()
            threading.Thread(target=_read_lines, args=(process, lines), daemon=True).start()
            timeout_seconds, first_case = START_TIMEOUT_SECONDS, case_index
            while line := _next_line(lines, timeout_seconds):
                if case := parse_case(line):
                    add_case(case)
                    case_index, timeout_seconds = case_index + 1, CASE_TIMEOUT_SECONDS + 10
            if process.poll() is None and line is None:
                process.kill()
                problem = f"it hung for {timeout_seconds} s"
            else:
                problem = f"it ended with status {process.wait()}" if process.wait() or case_index < end_case else ""
        if problem:
            print(f"  {part.name} {case_index}: {problem}", flush=True)
            add_case(Case(part.name, f"{part.name} {seed}/{case_index}", FAILED, problem, 0, 0, 0))
            case_index += 1
        elif case_index == first_case:
            return


def _read_lines(process: subprocess.Popen, lines: "queue.Queue[str]") -> None:
    for line in process.stdout:
        lines.put(line)
    lines.put("")


def _next_line(lines: "queue.Queue[str]", timeout_seconds: float) -> str | None:
    """Return the next line; empty where the process has ended, None at the timeout."""
    try:
        return lines.get(timeout=timeout_seconds)
    except queue.Empty:
        return None


def build_elbow_files(folder: Path) -> None:
    """Build the files of the elbow that do not exist yet: rig, two recordings, model and bound file."""
    import bpy

    import fdda_addon
    from benchmarks.stress_playback import bind_elbow
    from fdda_addon.cli.main import main as run_verb

    fdda_addon.register()
    bind_elbow(folder)
    recording = folder / "short recording"
    command = ["record", str(folder / "elbow.blend"), str(recording), "--poses", "40"]
    if not recording.exists() and run_verb(command, "fdda"):
        sys.exit(1)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    fdda_addon.unregister()


def format_table(cases: list[Case]) -> str:
    """Format a table with a row for each part: numbers of cases, times, memory and position errors."""
    lines = [
        "| part | cases | refused | passed | failed | slowest, s | peak per case, MB | memory growth, MB | "
        "deviation, mm |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(case.part for case in cases):
        part_cases = [case for case in cases if case.part == name]
        counts = [sum(case.outcome == outcome for case in part_cases) for outcome in (REFUSED, PASSED, FAILED)]
        error_mm = max((case.error_m for case in part_cases), default=0) * 1000
        lines.append(
            f"| {name} | {len(part_cases):,} | " + " | ".join(f"{count:,}" for count in counts) + f" | "
            f"{max(case.seconds for case in part_cases):.1f} | {max(case.peak_mb for case in part_cases):.0f} | "
            f"{round(memory_growth_mb(part_cases))} | {error_mm:.2g} |"
        )
    return "\n".join(lines)


def memory_growth_mb(cases: list[Case]) -> float:
    """Return how much the memory of a part grows in its second half, when libraries and files are already loaded."""
    memory_mb = [case.memory_mb for case in cases if case.memory_mb]
    half = len(memory_mb) // 2
    if half < 5:
        return 0.0
    # Memory varies from case to case: compare medians of a tenth of the cases each.
    count = max(1, len(memory_mb) // 10)
    middle, last = sorted(memory_mb[half : half + count]), sorted(memory_mb[-count:])
    return last[len(last) // 2] - middle[len(middle) // 2]


def main() -> int:
    """Run the soak test; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--part",
        action="append",
        choices=[part.name for part in SOAK_PARTS],
        help="run only this part; may be repeated",
    )
    parser.add_argument("--scale", type=float, default=1.0, help="factor for the numbers of cases")
    parser.add_argument("--work", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    folder = options.folder.absolute()
    if options.work:
        name, first_case, end_case = options.work
        run_part(name, folder, options.seed, int(first_case), int(end_case))
    folder.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    build_elbow_files(folder)
    cases: list[Case] = []
    with open(folder / "cases.jsonl", "w", encoding="utf-8") as file:

        def add_case(case: Case) -> None:
            cases.append(case)
            file.write(json.dumps(asdict(case)) + "\n")

        for part in select_parts(options.part):
            part_started = time.perf_counter()
            count = max(1, round(part.count * options.scale))
            watch_part(SoakPart(part.name, count, part.cases_per_process), folder, options.seed, add_case)
            print(f"{part.name}: {time.perf_counter() - part_started:.0f} s", flush=True)
    print(format_table(cases))
    failed_cases = [case for case in cases if case.outcome == FAILED]
    for case in failed_cases[:MAX_SHOWN_CASES]:
        print(f"{case.name}: {case.text}")
    names = dict.fromkeys(case.part for case in cases)
    growing = [name for name in names if memory_growth_mb([c for c in cases if c.part == name]) > MAX_GROWTH_MB]
    for name in growing:
        print(f"{name}: memory grows")
    print(
        f"{len(cases):,} cases, {len(failed_cases)} failed; seed {options.seed}, {time.perf_counter() - started:.0f} s"
    )
    return int(bool(failed_cases or growing))


if __name__ == "__main__":
    sys.exit(main())
