# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure the error by number of poses, for three samplings: `python benchmarks/sampling.py OUT [--rig FILE.blend]`.

Normal is the default of `record`. Uniform is `--spread 10`. Refined starts with a recording of normal poses;
`record --refine` then adds poses where the error of the model is largest, and `train --warm-start` trains on them. All
models are measured on the same held-out poses. Writes OUT/sampling.json and prints a table.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FIRST_POSES, POSES_STEP, LAST_POSES = 500, 250, 1500
HELD_OUT_POSES = 300
HELD_OUT_SEED = 1
STATISTICS = ("mean", "p999", "max")


def run_verb(*arguments: object) -> None:
    """Run a verb of the command line."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "fdda_addon", *map(str, arguments)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)


def held_out_errors(rig: Path, model: Path) -> dict:
    """Measure the held-out errors of a model and of linear skinning, mm."""
    errors_path = model.with_suffix(".errors.json")
    run_verb("evaluate", rig, model, "--json", errors_path, "--poses", HELD_OUT_POSES, "--seed", HELD_OUT_SEED)
    errors = json.loads(errors_path.read_text(encoding="utf-8"))
    return {kind: {name: errors[kind][name] for name in STATISTICS} for kind in ("fdda", "linear")}


def errors_of_random_poses(
    rig: Path, folder: Path, name: str, options: list, seed: int, last_poses: int
) -> dict[int, dict]:
    """Train on one recording per number of poses; return the errors by number of poses."""
    errors = {}
    for poses in range(FIRST_POSES, last_poses + 1, POSES_STEP):
        print(f"seed {seed}, {name}, {poses} poses", file=sys.stderr)
        recording, model = folder / f"{name}_{poses}", folder / f"{name}_{poses}.onnx"
        run_verb("record", rig, recording, "--poses", poses, "--seed", seed, *options)
        run_verb("train", recording, model, "--seed", seed)
        errors[poses] = held_out_errors(rig, model)
        shutil.rmtree(recording)
    return errors


def errors_of_refinement(rig: Path, folder: Path, seed: int, last_poses: int) -> dict[int, dict]:
    """Refine one recording step by step; return the errors by number of poses."""
    recording, model = folder / "refined", folder / "refined.onnx"
    run_verb("record", rig, recording, "--poses", FIRST_POSES, "--seed", seed)
    run_verb("train", recording, model, "--seed", seed)
    errors = {FIRST_POSES: held_out_errors(rig, model)}
    for poses in range(FIRST_POSES + POSES_STEP, last_poses + 1, POSES_STEP):
        print(f"seed {seed}, refined, {poses} poses", file=sys.stderr)
        run_verb("record", rig, recording, "--refine", model, "--poses", POSES_STEP, "--seed", seed)
        run_verb("train", recording, model, "--seed", seed, "--warm-start")
        errors[poses] = held_out_errors(rig, model)
    shutil.rmtree(recording)
    return errors


def format_table(results: list[dict]) -> str:
    """Format the medians over the seeds as a Markdown table."""
    samplings = list(results[0])
    lines = [
        "| poses | " + " | ".join(samplings) + " |",
        "|---" * (len(samplings) + 1) + "|",
    ]
    for poses in results[0][samplings[0]]:
        cells = []
        for sampling in samplings:
            medians = [statistics.median(r[sampling][poses]["fdda"][name] for r in results) for name in STATISTICS]
            cells.append("{:.4f} / {:.2f} / {:.1f}".format(*medians))
        lines.append(f"| {poses} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Measure the three samplings with every seed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for all output")
    parser.add_argument("--rig", type=Path, help="a .blend file to measure instead of the arm")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], help="seeds of the recordings and trainings")
    parser.add_argument("--last", type=int, default=LAST_POSES, help=f"largest number of poses (default {LAST_POSES})")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rig = options.rig or options.out / "arm.blend"
    if options.rig is None:
        run_verb("build-arm", rig)
    results = []
    for seed in options.seeds:
        folder = options.out / f"seed_{seed}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        results.append(
            {
                "uniform": errors_of_random_poses(rig, folder, "uniform", ["--spread", 10], seed, options.last),
                "normal": errors_of_random_poses(rig, folder, "normal", [], seed, options.last),
                "refined": errors_of_refinement(rig, folder, seed, options.last),
            }
        )
    content = {"unit": "mm", "held_out": HELD_OUT_POSES, "seeds": options.seeds, "results": results}
    (options.out / "sampling.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    print(f"Held-out error in mm, mean / 99.9 % / max, medians over seeds {', '.join(map(str, options.seeds))}:\n")
    print(format_table(results))


if __name__ == "__main__":
    main()
