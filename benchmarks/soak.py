# SPDX-License-Identifier: GPL-3.0-or-later
"""Does to files, processes and characters what must not harm them, and prints what held and what fell short:

    python benchmarks/soak.py out/soak [--seed 1] [--part NAME ...] [--scale 1.0]

Each part runs in processes of its own, which are watched: one that dies is a crash, one that says nothing for longer
than 30 seconds hangs, and the part goes on behind it. What is done follows from the seed alone. Exit status 1 where
something fell short; every case is a line of out/soak/cases.jsonl.
"""

import argparse
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.soaking.cases import FELL_SHORT, PLAYED, REFUSED, Case, heard  # noqa: E402

CASE_TIMEOUT_SECONDS = 30
START_TIMEOUT_SECONDS = 120
"""Seconds until the first case: Blender and torch are loaded."""
MAX_GROWTH_MB = 60
"""What a part may take more of memory in its second half than in its first, per process."""
MAX_SHOWN_CASES = 12


@dataclass(frozen=True)
class SoakPart:
    """A part of the soak: its name, how many cases, and how many a process."""

    name: str
    count: int
    each: int


SOAK_PARTS = (
    SoakPart("models", 3000, 750),
    SoakPart("recordings", 2000, 500),
    SoakPart("kills", 45, 45),
    SoakPart("disks", 40, 40),
    SoakPart("outputs", 60, 60),
    SoakPart("signals", 20, 20),
    SoakPart("frames", 10_000, 10_000),
    SoakPart("undo", 1000, 1000),
    SoakPart("loads", 200, 200),
    SoakPart("paths", 17, 17),
    SoakPart("time", 300, 100),
    SoakPart("armatures", 200, 100),
    SoakPart("mode", 1000, 1000),
    SoakPart("topology", 1000, 1000),
    SoakPart("controls", 300, 300),
)


def run_part(part: str, folder: Path, seed: int, first: int, end: int) -> None:
    """Be the process of a part."""
    if part == "recordings":
        from benchmarks.soaking.recordings import run
    elif part == "signals":
        from benchmarks.soaking.signals import run
    elif part == "models":
        from benchmarks.soaking.models import run
    elif part == "outputs":
        from benchmarks.soaking.outputs import run
    elif part in ("kills", "disks"):
        from benchmarks.soaking import interruptions

        run = interruptions.run_kills if part == "kills" else interruptions.run_full_disks
    elif part in ("time", "armatures"):
        from benchmarks.soaking import inputs

        run = inputs.run_time if part == "time" else inputs.run_armatures
    elif part in ("mode", "topology", "controls"):
        from benchmarks.soaking import changes

        run = getattr(changes, f"run_{part}")
    else:
        from benchmarks.soaking import playback

        run = getattr(playback, f"run_{part}")
    run(folder, seed, first, end)
    sys.stdout.flush()
    # What Blender does at its end is not what is measured here.
    os._exit(0)


def watch_part(part: SoakPart, folder: Path, seed: int, hear: Callable[[Case], None]) -> None:
    """Run a part, process by process; crashes and hangs become cases."""
    place = 0
    while place < part.count:
        end = min(place + part.each, part.count)
        command = [
            sys.executable,
            __file__,
            str(folder),
            "--seed",
            str(seed),
            "--work",
            part.name,
            str(place),
            str(end),
        ]
        with open(folder / f"{part.name}.log", "a", encoding="utf-8") as log:
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, errors="replace")
            lines: queue.Queue[str] = queue.Queue()
            threading.Thread(target=_read_lines, args=(process, lines), daemon=True).start()
            patience, began = START_TIMEOUT_SECONDS, place
            while line := _next_line(lines, patience):
                if case := heard(line):
                    hear(case)
                    place, patience = place + 1, CASE_TIMEOUT_SECONDS + 10
            if process.poll() is None and line is None:
                process.kill()
                problem = f"it hung for {patience} s"
            else:
                problem = f"it ended with {process.wait()}" if process.wait() or place < end else ""
        if problem:
            print(f"  {part.name} {place}: {problem}", flush=True)
            hear(Case(part.name, f"{part.name} {seed}/{place}", FELL_SHORT, problem, 0, 0, 0))
            place += 1
        elif place == began:
            return


def _read_lines(process: subprocess.Popen, lines: "queue.Queue[str]") -> None:
    for line in process.stdout:
        lines.put(line)
    lines.put("")


def _next_line(lines: "queue.Queue[str]", patience: float) -> str | None:
    try:
        return lines.get(timeout=patience)
    except queue.Empty:
        return None


def build_elbow_files(folder: Path) -> None:
    """The elbow: its file, two recordings, its model and its bound file, where they are not there yet."""
    import bpy

    import fdda_addon
    from benchmarks.stress_playback import _bound_elbow
    from fdda_addon.cli.main import main as run

    fdda_addon.register()
    _bound_elbow(folder)
    short = folder / "short recording"
    if not short.exists() and run(["record", str(folder / "elbow.blend"), str(short), "--poses", "40"], "fdda"):
        sys.exit(1)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    fdda_addon.unregister()


def table(cases: list[Case]) -> str:
    """A line for each part: cases, refused, held, fell short, and what they took."""
    lines = [
        "| part | cases | refused | held | fell short | slowest, s | peak of a case, MB | memory grew, MB | off, mm |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(case.part for case in cases):
        own = [case for case in cases if case.part == name]
        counts = [sum(case.outcome == outcome for case in own) for outcome in (REFUSED, PLAYED, FELL_SHORT)]
        off = max((case.off for case in own), default=0) * 1000
        lines.append(
            f"| {name} | {len(own):,} | " + " | ".join(f"{count:,}" for count in counts) + f" | "
            f"{max(case.seconds for case in own):.1f} | {max(case.peak_mb for case in own):.0f} | "
            f"{round(growth_mb(own))} | {off:.2g} |"
        )
    return "\n".join(lines)


def growth_mb(cases: list[Case]) -> float:
    """MB that a part holds at its end beyond what it held at its half; what is loaded once is loaded by then."""
    held = [case.memory_mb for case in cases if case.memory_mb]
    half = len(held) // 2
    if half < 5:
        return 0.0
    # Each process begins anew: the median of the last tenth against that behind the half.
    part = max(1, len(held) // 10)
    middle, last = sorted(held[half : half + part]), sorted(held[-part:])
    return last[len(last) // 2] - middle[len(middle) // 2]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", action="append", choices=[part.name for part in SOAK_PARTS], help="only this one")
    parser.add_argument("--scale", type=float, default=1.0, help="of the numbers of cases")
    parser.add_argument("--work", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    folder = options.folder.absolute()
    if options.work:
        name, first, end = options.work
        run_part(name, folder, options.seed, int(first), int(end))
    folder.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    build_elbow_files(folder)
    cases: list[Case] = []
    with open(folder / "cases.jsonl", "w", encoding="utf-8") as file:

        def hear(case: Case) -> None:
            cases.append(case)
            file.write(json.dumps(asdict(case)) + "\n")

        for part in SOAK_PARTS:
            if not options.part or part.name in options.part:
                began = time.perf_counter()
                count = part.count if part.name == "paths" else max(1, round(part.count * options.scale))
                watch_part(SoakPart(part.name, count, part.each), folder, options.seed, hear)
                print(f"{part.name}: {time.perf_counter() - began:.0f} s", flush=True)
    print(table(cases))
    bad = [case for case in cases if case.outcome == FELL_SHORT]
    for case in bad[:MAX_SHOWN_CASES]:
        print(f"{case.name}: {case.text}")
    names = dict.fromkeys(case.part for case in cases)
    grown = [name for name in names if growth_mb([c for c in cases if c.part == name]) > MAX_GROWTH_MB]
    for name in grown:
        print(f"{name}: memory grows")
    print(f"{len(cases):,} cases, {len(bad)} fell short; seed {options.seed}, {time.perf_counter() - started:.0f} s")
    return int(bool(bad or grown))


if __name__ == "__main__":
    sys.exit(main())
