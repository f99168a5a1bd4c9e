# SPDX-License-Identifier: GPL-3.0-or-later
"""Error against number of poses for three ways to choose them: `python benchmarks/sampling.py OUT [--rig FILE.blend]`.

Normal: the default of `record`. Uniform: `--spread 10`. Refined: a first recording of normal poses, to which
`record --refine` adds where the model is worst, trained on with `--warm-start` each time. Every model is measured on
the same held-out poses, which none was trained or chosen on. Writes OUT/sampling.json and prints a table.
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
    """Held-out errors of a model and of linear skinning, mm."""
    path = model.with_suffix(".errors.json")
    run_verb("evaluate", rig, model, "--json", path, "--poses", HELD_OUT_POSES, "--seed", HELD_OUT_SEED)
    found = json.loads(path.read_text(encoding="utf-8"))
    return {kind: {figure: found[kind][figure] for figure in STATISTICS} for kind in ("fdda", "linear")}


def errors_of_random_poses(rig: Path, folder: Path, name: str, options: list, seed: int, last: int) -> dict[int, dict]:
    """Errors by number of poses of recordings that are drawn in one go."""
    found = {}
    for poses in range(FIRST_POSES, last + 1, POSES_STEP):
        print(f"seed {seed}, {name}, {poses} poses", file=sys.stderr)
        recording, model = folder / f"{name}_{poses}", folder / f"{name}_{poses}.onnx"
        run_verb("record", rig, recording, "--poses", poses, "--seed", seed, *options)
        run_verb("train", recording, model, "--seed", seed)
        found[poses] = held_out_errors(rig, model)
        shutil.rmtree(recording)
    return found


def errors_of_refinement(rig: Path, folder: Path, seed: int, last: int) -> dict[int, dict]:
    """Errors by number of poses of one recording that grows where the model is worst."""
    recording, model = folder / "refined", folder / "refined.onnx"
    run_verb("record", rig, recording, "--poses", FIRST_POSES, "--seed", seed)
    run_verb("train", recording, model, "--seed", seed)
    found = {FIRST_POSES: held_out_errors(rig, model)}
    for poses in range(FIRST_POSES + POSES_STEP, last + 1, POSES_STEP):
        print(f"seed {seed}, refined, {poses} poses", file=sys.stderr)
        run_verb("record", rig, recording, "--refine", model, "--poses", POSES_STEP, "--seed", seed)
        run_verb("train", recording, model, "--seed", seed, "--warm-start")
        found[poses] = held_out_errors(rig, model)
    shutil.rmtree(recording)
    return found


def table(results: list[dict]) -> str:
    """Medians over the seeds as Markdown."""
    ways = list(results[0])
    lines = [
        "| poses | " + " | ".join(ways) + " |",
        "|---" * (len(ways) + 1) + "|",
    ]
    for poses in results[0][ways[0]]:
        cells = []
        for way in ways:
            values = [statistics.median(r[way][poses]["fdda"][figure] for r in results) for figure in STATISTICS]
            cells.append("{:.4f} / {:.2f} / {:.1f}".format(*values))
        lines.append(f"| {poses} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for all that is made")
    parser.add_argument("--rig", type=Path, help="a .blend file in place of the arm")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], help="of recordings and trainings")
    parser.add_argument("--last", type=int, default=LAST_POSES, help=f"most poses (default {LAST_POSES})")
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
    print(table(results))


if __name__ == "__main__":
    main()
