# SPDX-License-Identifier: GPL-3.0-or-later
"""All figures of speed with one command: `python benchmarks/bench.py OUT [--rig FILE.blend …]`.

Builds the arm at its three densities, records, trains and binds each, and measures; the same for every rig given.
Writes OUT/bench.json and prints the results as a table.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
POSES = 1000


def run(*arguments: object) -> float:
    """Run a command in the project's environment; returns its seconds."""
    start = time.monotonic()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *map(str, arguments)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    return time.monotonic() - start


def measure(*arguments: object) -> dict:
    """One measurement of `measure.py`, in a process of its own."""
    command = [sys.executable, str(ROOT / "benchmarks" / "measure.py"), *map(str, arguments)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.strip().splitlines()[-1])


def bench(name: str, rig: Path, folder: Path, poses: int) -> dict:
    """Everything that is measured of one rig.

    Args:
        name: of the rig. rig: its .blend file.
        folder: where recording and model go.
        poses: to record.
    """
    recording, model, bound = folder / f"{name}_recording", folder / f"{name}.onnx", folder / f"{name}_bound.blend"
    print(f"{name}: record", file=sys.stderr)
    seconds = {"record": run("-m", "fdda_addon", "record", rig, recording, "--poses", poses)}
    print(f"{name}: train", file=sys.stderr)
    seconds["train"] = run("-m", "fdda_addon", "train", recording, model)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    run("-m", "fdda_addon", "bind", rig, model, bound)
    errors_path = folder / f"{name}_errors.json"
    run("-m", "fdda_addon", "evaluate", rig, model, "--json", errors_path)
    errors = json.loads(errors_path.read_text())
    print(f"{name}: measure", file=sys.stderr)
    return {
        "name": name,
        "frame": measure("frames", rig, model),
        "inference": measure("inference", model),
        "crowd": measure("crowd", bound),
        "cold_start": measure("cold-start", bound),
        "recording": measure("recording", rig, 300),
        "poses": poses,
        "seconds": seconds,
        "model_mb": model.stat().st_size / 1e6,
        "peak_memory_mb": peak,
        "errors_mm": {key: errors[key] for key in ("fdda", "linear")},
    }


FRAME_ROWS = (
    ("true rig, ms", lambda r: f"{r['frame']['rig']['median']:.2f}"),
    ("Armature modifier alone, ms", lambda r: f"{r['frame']['linear']['median']:.2f}"),
    ("FDDA, ms", lambda r: f"{r['frame']['fdda']['median']:.2f}"),
    ("floor: FDDA with constant positions, ms", lambda r: f"{r['frame']['floor']['median']:.2f}"),
    ("the model alone, ms", lambda r: f"{r['inference']['ms_at_1']:.2f}"),
    ("**rig / FDDA**", lambda r: f"**{r['frame']['ratio']:.1f}**"),
    ("a character of a crowd of 20, ms", lambda r: f"{r['crowd']['ms_a_character']:.2f}"),
    ("… as a part of one alone", lambda r: f"{100 * r['crowd']['ratio']:.0f} %"),
    ("opening a bound file to its next frame, s", lambda r: f"{r['cold_start']['seconds']:.2f}"),
    ("recording, poses a second", lambda r: f"{r['recording']['poses_a_second']:.0f}"),
    ("… as a part of a bare loop's", lambda r: f"{100 * r['recording']['ratio']:.0f} %"),
    ("training, s", lambda r: f"{r['seconds']['train']:.0f}"),
    ("peak memory of record and train so far, MB", lambda r: f"{r['peak_memory_mb']:.0f}"),
    ("model, MB", lambda r: f"{r['model_mb']:.1f}"),
    ("held-out error, mean / max, mm", lambda r: _errors(r["errors_mm"]["fdda"])),
    ("… of the linear layer", lambda r: _errors(r["errors_mm"]["linear"])),
)


def _errors(errors: dict) -> str:
    return f"{errors['mean']:.3f} / {errors['max']:.1f}"


def table(results: list[dict]) -> str:
    """The results as Markdown, a column a rig."""
    lines = [
        "| | " + " | ".join(f"{r['name']}, {r['frame']['vertices']:,} vertices" for r in results) + " |",
        "|---" * (len(results) + 1) + "|",
    ]
    lines += [f"| {label} | " + " | ".join(show(r) for r in results) + " |" for label, show in FRAME_ROWS]
    return "\n".join(lines)


def machine() -> dict:
    """What the figures were measured on."""
    model = next(
        (line.partition(":")[2].strip() for line in _cpu_lines() if line.startswith("model name")), platform.machine()
    )
    return {
        "date": date.today().isoformat(),
        "processor": model,
        "cores": os.cpu_count(),
        "python": sys.version.split()[0],
    }


def _cpu_lines() -> list[str]:
    path = Path("/proc/cpuinfo")
    return path.read_text().splitlines() if path.exists() else []


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for all that is made")
    parser.add_argument("--densities", type=int, nargs="*", default=[1, 2, 3], help="of the arm (default 1 2 3)")
    parser.add_argument("--rig", type=Path, action="append", default=[], help="a .blend file to measure as well")
    parser.add_argument("--poses", type=int, default=POSES)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    results = []
    for density in options.densities:
        rig = options.out / f"arm{density}.blend"
        run("-m", "fdda_addon", "build-arm", rig, "--density", density)
        results.append(bench(f"arm{density}", rig, options.out, options.poses))
    results += [bench(rig.stem, rig, options.out, options.poses) for rig in options.rig]
    about = machine() | {"blender": results[0]["frame"]["blender"]}
    (options.out / "bench.json").write_text(json.dumps({"machine": about, "rigs": results}, indent=1))
    print(f"{about['date']}, Blender {about['blender']}, {about['processor']}, {about['cores']} cores\n")
    print(table(results))


if __name__ == "__main__":
    main()
