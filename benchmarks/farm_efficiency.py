# SPDX-License-Identifier: GPL-3.0-or-later
"""Time a farm of six characters: the verbs one after the other, on a cluster of two workers, and on one worker.

    .venv-farm/bin/python benchmarks/farm_efficiency.py out/efficiency

Efficiency is the time of the verbs one after the other, divided by twice the time of two workers; the result is the
median of several rounds. The overhead of the engine is the part of one worker's time in which no verb runs. Processor
time shows how many cores the verbs use.
"""

import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from farm.characters import read_plan  # noqa: E402
from farm.fingerprints import read_manifest  # noqa: E402
from farm.run import SUCCESS_STATES, run_task  # noqa: E402
from farm.tasks import make_tasks  # noqa: E402

HUMANS = ("BASIC_HUMAN", "HUMAN")
FARM_TEMPLATE = """
[farm]
work = "{work}"
pictures = false
[defaults]
poses = {poses}
shards = {shards}
evaluate_poses = 20
train = {{ epochs = {epochs}, hidden = [32, 32] }}
"""
ARM_TEMPLATE = '[characters.arm{n}]\nrig = "arm{density}.blend"\noutput = "{out}/arm{n}"\nseed = {n}\n'
HUMAN_TEMPLATE = '[characters.{name}]\nrig = "{name}.blend"\noutput = "{out}/{name}"\nsample = ["action:rehearsal"]\n'


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--poses", type=int, default=300)
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--densities", type=int, nargs="+", default=[1, 1, 2, 3], help="densities of the arms")
    parser.add_argument("--shards", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=1, help="number of times to measure everything")
    parser.add_argument("--without-one", action="store_true", help="do not measure one worker")
    options = parser.parse_args()
    out = options.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    build_rigs(out)
    rounds = []
    for _ in range(options.rounds):
        rounds.append(measure_round(out, options))
        print(json.dumps(rounds[-1], indent=1), flush=True)
    names = [name for name, value in rounds[0].items() if isinstance(value, float)]
    medians = {name: round(statistics.median(results[name] for results in rounds), 3) for name in names}
    (out / "efficiency.json").write_text(json.dumps({"rounds": rounds, "medians": medians}, indent=1) + "\n")
    print(json.dumps(medians, indent=1))
    return 0


def measure_round(out: Path, options: argparse.Namespace) -> dict:
    """Run the tasks once in each of the three ways; return the figures."""
    results: dict = {"cores": os.cpu_count(), "load": os.getloadavg()[0]}
    for name, workers in (("verbs", 0), ("two workers", 2), ("one worker", 1)):
        if workers == 1 and options.without_one:
            continue
        results[name] = measure(out, name.replace(" ", "_"), workers, options)
    verbs, two_workers = results["verbs"], results["two workers"]
    results["efficiency of two workers"] = round(verbs["seconds"] / (2 * two_workers["seconds"]), 3)
    for name, workers in (("one worker", 1), ("two workers", 2)):
        if figures := results.get(name):
            idle_ratio = 1 - figures["seconds of verbs"] / (workers * figures["seconds"])
            results[f"part of the time of {name} without a verb"] = round(idle_ratio, 3)
    results["cores that verbs use one after the other"] = round(verbs["processor seconds"] / verbs["seconds"], 2)
    return results


def build_rigs(out: Path) -> None:
    for density in (1, 2, 3):
        if not (path := out / f"arm{density}.blend").exists():
            command = [sys.executable, "-m", "fdda_addon", "build-arm", path, "--density", str(density)]
            subprocess.run(command, cwd=ROOT, check=True)
    for name in HUMANS:
        if not (path := out / f"{name.lower()}.blend").exists():
            subprocess.run([sys.executable, "-m", "blend_fixtures.characters.rigify", name, path], cwd=ROOT, check=True)


def measure(out: Path, name: str, workers: int, options: argparse.Namespace) -> dict:
    """Run the farm from an empty work folder to its end; 0 workers run the verbs here, others run on a cluster."""
    work = out / f"work_{name}"
    shutil.rmtree(work, ignore_errors=True)
    plan_parts = [FARM_TEMPLATE.format(work=work, poses=options.poses, epochs=options.epochs, shards=options.shards)]
    plan_parts += [
        ARM_TEMPLATE.format(n=n, density=density, out=f"out_{name}") for n, density in enumerate(options.densities)
    ]
    plan_parts += [HUMAN_TEMPLATE.format(name=human.lower(), out=f"out_{name}") for human in HUMANS]
    path = out / f"{name}.toml"
    path.write_text("".join(plan_parts))
    plan = read_plan(path)
    tasks = make_tasks(plan)
    usage_before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    if workers:
        command = [sys.executable, "-m", "farm", path, "--workers", str(workers), "--dashboard-port", "0"]
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    else:
        for task in tasks:
            outcome = run_task(plan.farm, tasks, task)
            assert outcome.state in SUCCESS_STATES, outcome
    seconds, usage_after = time.monotonic() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    manifests = [read_manifest(task) for task in tasks.values()]
    return {
        "seconds": round(seconds, 1),
        "seconds of verbs": round(sum(manifest.seconds for manifest in manifests), 1),
        "processor seconds": round(_cpu_seconds(usage_after) - _cpu_seconds(usage_before), 1),
        "peak MB of a process": max(manifest.peak_mb for manifest in manifests),
        "tasks": len(tasks),
    }


def _cpu_seconds(usage: resource.struct_rusage) -> float:
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    sys.exit(main())
