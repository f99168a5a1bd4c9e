# SPDX-License-Identifier: GPL-3.0-or-later
"""Kills the processes of a farm at random, fills its disk, and compares what it made with an undisturbed run.

    .venv-farm/bin/python benchmarks/farm_chaos.py out/chaos [--kills 30] [--seed 0]

Two characters go through the whole graph twice. The first run is left alone. During the second, every few seconds a
process of it is killed with signal 9: a worker of Dask, or a verb with all that it started; once the scheduler with
everything; and once the disk that the files go through is full for a while. Who runs the farm does nothing but start it
again while it says "try again". Then what was made is compared: recordings and models byte by byte.

The disk is a tmpfs that only this command sees, for which it needs Linux, and root or user namespaces.
"""

import argparse
import hashlib
import itertools
import json
import os
import random
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from farm.characters import Plan, read_plan  # noqa: E402
from farm.fingerprints import check_outputs, read_manifest  # noqa: E402
from farm.tasks import MERGE, RECORD, REFINE, TRAIN, make_tasks  # noqa: E402
from fdda_addon.core.output import is_temporary_name  # noqa: E402

NAMESPACE_VARIABLE = "FDDA_CHAOS_INSIDE"
DISK_MB = 400
TRY_AGAIN, KILLED = 75, -9
DISK_FULL_SECONDS = 12
MAX_LOST_POSES = 2 * 250
"""Poses that a kill may lose: a batch that is being written, and one that is collected."""
PLAN = """
[farm]
work = "{work}"
retry_seconds = 1
pictures = false
[defaults]
evaluate_poses = 10
train = {{ epochs = 4, hidden = [16, 16] }}
[characters.elbow]
rig = "elbow.blend"
output = "{output}/elbow"
poses = 6000
shards = 4
actions = ["elbow_wave"]
goal_mm = 0.001
rounds = 1
refine_poses = 300
[characters.arm]
rig = "arm.blend"
output = "{output}/arm"
poses = 1200
shards = 3
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.out = options.out.absolute()
    if not os.environ.get(NAMESPACE_VARIABLE):
        return _run_in_namespace(sys.argv[1:])
    disk = options.out / "disk"
    disk.mkdir(parents=True, exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", disk], check=True)
    calm = write_plan(options.out, "calm", options.out / "calm_work")
    print("An undisturbed run.", flush=True)
    started = time.monotonic()
    status = subprocess.run(command(calm), cwd=ROOT, check=False).returncode
    print(f"It took {time.monotonic() - started:.0f} s and ended with status {status}.", flush=True)
    if status:
        return 1
    random_numbers = random.Random(options.seed)
    storm = RandomFaults(options.kills, random_numbers, disk)
    runs = 0
    while storm.kills < options.kills or not runs:
        runs += 1
        shutil.rmtree(disk / "work", ignore_errors=True)
        plan = write_plan(options.out, "storm", disk / "work")
        if not storm.through(plan):
            return 1
        if wrong := differences(calm, plan):
            print("\n".join(["It is not what the undisturbed run made:", *wrong]))
            return 1
        print(f"Run {runs} in the storm: the same files as undisturbed, after {storm.kills} kills so far.", flush=True)
    print(json.dumps(storm.summary() | {"runs": runs}, indent=1))
    return 0


def _run_in_namespace(arguments: list[str]) -> int:
    """Run again where a disk can be made that nobody else sees."""
    own = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    start = ["unshare", *own, "--mount", "--propagation", "private", sys.executable, __file__, *arguments]
    return subprocess.run(start, env={**os.environ, NAMESPACE_VARIABLE: "1"}, check=False).returncode


def write_plan(folder: Path, name: str, work: Path) -> Plan:
    for rig in ("elbow", "arm"):
        shutil.copyfile(ROOT / "blend_fixtures" / f"{rig}.blend", folder / f"{rig}.blend")
    path = folder / f"{name}.toml"
    path.write_text(PLAN.format(work=work, output=folder / f"out_{name}"))
    return read_plan(path)


def command(plan: Plan) -> list[str]:
    report = ["--report", str(plan.path.with_suffix(".html"))]
    return [sys.executable, "-m", "farm", str(plan.path), "--workers", "2", "--dashboard-port", "0", *report]


class RandomFaults:
    """What happens to a farm, and how often it did."""

    def __init__(self, kills: int, numbers: random.Random, disk: Path):
        self.wanted, self._numbers, self._disk = kills, numbers, disk
        self.workers = self.verbs = self.schedulers = self.fillings = self.starts = 0
        self.statuses: list[int] = []

    @property
    def kills(self) -> int:
        return self.workers + self.verbs + self.schedulers

    def summary(self) -> dict:
        own = ("kills", "workers", "verbs", "schedulers", "fillings", "starts", "statuses")
        return {key: getattr(self, key) for key in own}

    def through(self, plan: Plan) -> bool:
        """Bring a farm to its end, whatever happens to it."""
        while True:
            farm = subprocess.Popen(command(plan), cwd=ROOT, stdout=subprocess.PIPE, text=True)
            self.starts += 1
            stop = threading.Event()
            weather = threading.Thread(target=self._rage, args=(farm, stop))
            for line in farm.stdout:
                print(f"  {line}", end="", flush=True)
                # Once it runs: what is killed while it starts is no work that could be lost.
                if " tasks to do" in line:
                    weather.start()
            status = farm.wait()
            stop.set()
            if weather.ident:
                weather.join()
            self.statuses.append(status)
            if status not in (TRY_AGAIN, KILLED):
                return status == 0
            print(f"The farm ended with status {status} and is started again.", flush=True)

    def _rage(self, farm: subprocess.Popen, stop: threading.Event) -> None:
        while not stop.wait(self._numbers.uniform(1.5, 4)) and self.kills < self.wanted:
            if not self.fillings and self.kills >= self.wanted // 4:
                self._fill(stop)
            elif not self.schedulers and self.kills >= self.wanted // 2:
                self.schedulers += 1
                farm.kill()
                return
            else:
                self._kill_one(farm.pid)

    def _kill_one(self, farm: int) -> None:
        """Kill a worker, or every third time a verb with all that it started; a verb whose worker is gone too."""
        verbs = [process for process in psutil.process_iter() if is_farm_process(process, self._disk)]
        workers = [process for process in children(farm) if "spawn_main" in command_line(process)]
        if verbs and self.kills % 3 == 2:
            victim = self._numbers.choice(verbs)
            for process in [*children(victim.pid), victim]:
                kill(process)
            self.verbs += 1
        elif workers and kill(self._numbers.choice(workers)):
            self.workers += 1

    def _fill(self, stop: threading.Event) -> None:
        self.fillings += 1
        print("The disk is full.", flush=True)
        ballast = self._disk / "ballast"
        try:
            with open(ballast, "wb", buffering=0) as file:
                while True:
                    file.write(bytes(1 << 20))
        except OSError as error:
            print(f"  {error.strerror}", flush=True)
        stop.wait(DISK_FULL_SECONDS)
        ballast.unlink()
        print("The disk has room again.", flush=True)


def children(pid: int) -> list[psutil.Process]:
    try:
        return psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def command_line(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


def is_farm_process(process: psutil.Process, disk: Path) -> bool:
    """Whether a process is a verb of the farm on this disk; its worker may be gone."""
    try:
        return "fdda_addon" in process.cmdline() and Path(process.cwd()).is_relative_to(disk)
    except psutil.Error:
        return False


def kill(process: psutil.Process) -> bool:
    try:
        process.kill()
    except psutil.Error:
        return False
    return True


def differences(calm: Plan, storm: Plan) -> list[str]:
    """In what two farms differ that ran the same graph."""
    wrong = []
    first, second = make_tasks(calm), make_tasks(storm)
    for name, task in second.items():
        manifests = read_manifest(first[name]), check_outputs(task)
        if bool(manifests[0].skipped) != bool(manifests[1].skipped):
            wrong.append(f"{name} was not needed in one of them")
        if task.kind in (RECORD, MERGE, REFINE) and manifests[0].outputs != manifests[1].outputs:
            wrong.append(f"the recordings of {name} differ")
        if task.kind == TRAIN:
            models = [{n: own for n, own in manifest.outputs.items() if n.endswith(".onnx")} for manifest in manifests]
            if models[0] != models[1] or len(models[0]) != 1:
                wrong.append(f"the models of {name} differ")
        if task.kind in (RECORD, REFINE):
            wrong += find_repeated_poses(name, task.log)
    for own in calm.characters:
        other = next(one for one in storm.characters if one.name == own.name)
        pair = [hashlib.sha256((c.output / f"{c.name}.onnx").read_bytes()).digest() for c in (own, other)]
        if pair[0] != pair[1]:
            wrong.append(f"the bound models of {own.name} differ")
    partial_paths = [
        path
        for path in storm.farm.work.rglob("*")
        if is_temporary_name(path.name) or path.name.startswith((".new-", ".old-"))
    ]
    return wrong + [f"a partial file was left: {path}" for path in partial_paths]


def find_repeated_poses(name: str, log: Path) -> list[str]:
    """Whether poses were recorded twice: each start of the verb says how many are there, and none may be lost."""
    attempts = [
        [int(done) for done in re.findall(r"^poses: (\d+) of", text, re.MULTILINE)]
        for text in log.read_text().split("$ record")
    ]
    attempts = [counts for counts in attempts if counts]
    wrong = []
    for before, after in itertools.pairwise(attempts):
        # What is said to be done is evaluated; what was not on the disk yet is evaluated once more.
        if after[0] < max(before[0], before[-1] - MAX_LOST_POSES):
            wrong.append(f"{name} went on from {after[0]} poses after it had {before[-1]}")
    return wrong


if __name__ == "__main__":
    sys.exit(main())
