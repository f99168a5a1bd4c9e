# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure all speed figures with one command: `python benchmarks/bench.py OUT [--rig FILE.blend …]`.

Builds the arm at its three densities, records, trains and binds each arm, and measures it. Does the same for every rig
that `--rig` names. Writes OUT/bench.json and prints the results as a table. Then prints each time divided by the same
time of the previous run in OUT.
"""

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from datetime import date
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
POSES = 1000


class ProcessCost(NamedTuple):
    """Time and memory that a command took."""

    seconds: float
    peak_mb: float


def run(*arguments: object) -> ProcessCost:
    """Run a command in the project's environment."""
    start = time.monotonic()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    # wait4 gives the peak of this process alone. The resource module gives one maximum for all children.
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"{' '.join(command)} ended with status {process.returncode}.")
    return ProcessCost(time.monotonic() - start, usage.ru_maxrss / 1024)


def measure(*arguments: object) -> dict:
    """Run one measurement of `measure.py` in its own process and return its figures."""
    command = [sys.executable, str(ROOT / "benchmarks" / "measure.py"), *map(str, arguments)]
    finished = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(finished.stdout.strip().splitlines()[-1])


def bench(name: str, rig: Path, folder: Path, poses: int) -> dict:
    """Record, train and bind one rig, and return all its figures."""
    recording, model, bound = folder / f"{name}_recording", folder / f"{name}.onnx", folder / f"{name}_bound.blend"
    shutil.rmtree(recording, ignore_errors=True)
    print(f"{name}: record", file=sys.stderr)
    costs = {"record": run("-m", "fdda_addon", "record", rig, recording, "--poses", poses)}
    print(f"{name}: train", file=sys.stderr)
    costs["train"] = run("-m", "trainer", recording, model)
    run("-m", "fdda_addon", "bind", rig, model, bound)
    errors_path = folder / f"{name}_errors.json"
    run("-m", "fdda_addon", "evaluate", rig, model, "--json", errors_path)
    errors = json.loads(errors_path.read_text(encoding="utf-8"))
    print(f"{name}: measure", file=sys.stderr)
    return {
        "name": name,
        "frame": measure("frames", rig, model),
        "inference": measure("inference", model),
        "crowd": measure("crowd", bound),
        "cold_start": measure("cold-start", bound),
        "recording": measure("recording", rig, 100),
        "poses": poses,
        "seconds": {verb: cost.seconds for verb, cost in costs.items()},
        "peak_memory_mb": {verb: cost.peak_mb for verb, cost in costs.items()},
        "model_mb": model.stat().st_size / 1e6,
        "errors_mm": {key: errors[key] for key in ("fdda", "linear")},
    }


TABLE_ROWS = (
    ("rig, ms", lambda r: f"{_median(r, 'rig'):.2f}"),
    ("Armature modifier alone, ms", lambda r: f"{_median(r, 'linear'):.2f}"),
    ("FDDA, ms", lambda r: f"{_median(r, 'fdda'):.2f}"),
    ("the model alone, one pose, ms", lambda r: f"{_median(r, 'inference'):.2f}"),
    ("**rig / FDDA**", lambda r: f"**{r['frame']['ratio']:.2f}**"),
    ("per character in a crowd of 20, ms", lambda r: f"{r['crowd']['ms_a_character']:.2f}"),
    ("… in percent of a single character", lambda r: f"{100 * r['crowd']['ratio']:.0f} %"),
    ("from opening a bound file to its first correct frame, s", lambda r: f"{r['cold_start']['seconds']:.2f}"),
    ("recording, poses per second", lambda r: f"{r['recording']['poses_a_second']:.0f}"),
    ("… in percent of a bare loop's", lambda r: f"{100 * r['recording']['ratio']:.0f} %"),
    ("`record`, s / MB", lambda r: f"{r['seconds']['record']:.0f} / {r['peak_memory_mb']['record']:.0f}"),
    ("`train`, s / MB", lambda r: f"{r['seconds']['train']:.0f} / {r['peak_memory_mb']['train']:.0f}"),
    ("model, MB", lambda r: f"{r['model_mb']:.1f}"),
    ("held-out error, mean / max, mm", lambda r: _format_errors(r["errors_mm"]["fdda"])),
    ("… of linear skinning", lambda r: _format_errors(r["errors_mm"]["linear"])),
    (
        "… FDDA / linear skinning",
        lambda r: " / ".join(f"{100 * _error_ratio(r, statistic):.1f} %" for statistic in ("mean", "max")),
    ),
)


def _median(result: dict, timing: str) -> float:
    return result["frame"][timing]["median"]


def _error_ratio(result: dict, statistic: str) -> float:
    return result["errors_mm"]["fdda"][statistic] / result["errors_mm"]["linear"][statistic]


def _format_errors(errors: dict) -> str:
    return f"{errors['mean']:.3f} / {errors['max']:.1f}"


def format_table(results: list[dict]) -> str:
    """Format the results as a Markdown table with one column per rig."""
    lines = [
        "| | " + " | ".join(f"{r['name']}, {r['frame']['vertices']:,} vertices" for r in results) + " |",
        "|---" * (len(results) + 1) + "|",
    ]
    lines += [f"| {label} | " + " | ".join(format_cell(r) for r in results) + " |" for label, format_cell in TABLE_ROWS]
    return "\n".join(lines)


COMPARED_TIMES = (
    ("rig", lambda r: _median(r, "rig")),
    ("FDDA", lambda r: _median(r, "fdda")),
    ("model alone", lambda r: _median(r, "inference")),
    ("rig / FDDA", lambda r: r["frame"]["ratio"]),
    ("crowd", lambda r: r["crowd"]["ms_a_character"]),
)


def compare_with_last_run(last_results: list[dict], results: list[dict]) -> str:
    """Divide the times of each rig by those of the last run; one line per rig that both runs measured."""
    previous = {result["name"]: result for result in last_results}
    return "\n".join(
        f"{r['name']}, now / last run: "
        + ", ".join(f"{label} {get_time(r) / get_time(previous[r['name']]):.2f}" for label, get_time in COMPARED_TIMES)
        for r in results
        if r["name"] in previous
    )


def describe_machine() -> dict:
    """Describe the machine that the figures were measured on."""
    processor = next(
        (line.partition(":")[2].strip() for line in _cpu_lines() if line.startswith("model name")), platform.machine()
    )
    return {
        "date": date.today().isoformat(),
        "processor": processor,
        "cores": os.cpu_count(),
        "python": sys.version.split()[0],
    }


def _cpu_lines() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text().splitlines() if path.exists() else []


def main() -> None:
    """Measure the rigs that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for all output")
    parser.add_argument(
        "--densities", type=int, nargs="*", default=[1, 2, 3], help="densities of the arm (default 1 2 3)"
    )
    parser.add_argument("--rig", type=Path, action="append", default=[], help="another .blend file to measure")
    parser.add_argument("--poses", type=int, default=POSES)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rigs = {f"arm{density}": options.out / f"arm{density}.blend" for density in options.densities}
    for density, rig in zip(options.densities, rigs.values(), strict=True):
        run("-m", "fdda_addon", "build-arm", rig, "--density", density)
    results_path = options.out / "bench.json"
    last_results = json.loads(results_path.read_text(encoding="utf-8"))["rigs"] if results_path.exists() else []
    results = []
    for name, rig in (rigs | {rig.stem: rig for rig in options.rig}).items():
        results.append(bench(name, rig, options.out, options.poses))
        machine = describe_machine() | {"blender": results[0]["frame"]["blender"]}
        # Write after every rig: when one rig fails, the results of the others are kept.
        content = json.dumps({"machine": machine, "rigs": results}, indent=1)
        results_path.write_text(content, encoding="utf-8")
    print(f"{machine['date']}, Blender {machine['blender']}, {machine['processor']}, {machine['cores']} cores\n")
    print(format_table(results))
    if comparison := compare_with_last_run(last_results, results):
        print(f"\n{comparison}")


if __name__ == "__main__":
    main()
