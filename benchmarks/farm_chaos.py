# SPDX-License-Identifier: GPL-3.0-or-later
"""Kill a farm's processes at random, fill its disk, and compare its output with that of an undisturbed run.

    .venv-farm/bin/python benchmarks/farm_chaos.py out/chaos [--kills 30] [--seed 0]

Two characters go through the whole graph twice. The first run is undisturbed. During the second run, every few seconds
one of its processes is killed with signal 9: a Dask worker, or a verb with all its child processes. The scheduler is
killed once. The disk of the work folder is full once for a while. The farm is started again whenever its exit status
asks for it. Then the recordings and models of both runs are compared byte by byte.

The disk is a tmpfs that only this command sees. This needs Linux, and root or user namespaces.
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
"""Environment variable that is set in the process that runs in its own mount namespace."""
DISK_MB = 400
RETRY_STATUS, KILLED_STATUS = 75, -9
DISK_FULL_SECONDS = 12
MAX_LOST_POSES = 2 * 250
"""Poses that a kill may lose: the batch that is being written and the batch that is being recorded."""
PLAN_TEMPLATE = """
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
    undisturbed_plan = write_plan(options.out, "calm", options.out / "calm_work")
    print("Run the farm undisturbed.", flush=True)
    start_time = time.monotonic()
    status = subprocess.run(farm_command(undisturbed_plan), cwd=ROOT, check=False).returncode
    print(f"It took {time.monotonic() - start_time:.0f} s and ended with status {status}.", flush=True)
    if status:
        return 1
    random_numbers = random.Random(options.seed)
    faults = RandomFaults(options.kills, random_numbers, disk)
    runs = 0
    while faults.kills < options.kills or not runs:
        runs += 1
        shutil.rmtree(disk / "work", ignore_errors=True)
        disturbed_plan = write_plan(options.out, "storm", disk / "work")
        if not faults.run_farm(disturbed_plan):
            return 1
        if problems := find_differences(undisturbed_plan, disturbed_plan):
            print("\n".join(["The output differs from that of the undisturbed run:", *problems]))
            return 1
        print(
            f"Disturbed run {runs}: the same files as the undisturbed run, after {faults.kills} kills so far.",
            flush=True,
        )
    print(json.dumps(faults.summary() | {"runs": runs}, indent=1))
    return 0


def _run_in_namespace(arguments: list[str]) -> int:
    """Run this script again in a new mount namespace, where it can mount a disk that no other process sees."""
    user_options = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    start = ["unshare", *user_options, "--mount", "--propagation", "private", sys.executable, __file__, *arguments]
    return subprocess.run(start, env={**os.environ, NAMESPACE_VARIABLE: "1"}, check=False).returncode


def write_plan(folder: Path, name: str, work: Path) -> Plan:
    for rig in ("elbow", "arm"):
        shutil.copyfile(ROOT / "blend_fixtures" / f"{rig}.blend", folder / f"{rig}.blend")
    path = folder / f"{name}.toml"
    path.write_text(PLAN_TEMPLATE.format(work=work, output=folder / f"out_{name}"))
    return read_plan(path)


def farm_command(plan: Plan) -> list[str]:
    report = ["--report", str(plan.path.with_suffix(".html"))]
    return [sys.executable, "-m", "farm", str(plan.path), "--workers", "2", "--dashboard-port", "0", *report]


class RandomFaults:
    """Faults that happen to a farm at random times, and how often each happened."""

    def __init__(self, kills: int, random_numbers: random.Random, disk: Path):
        self.max_kills, self._random_numbers, self._disk = kills, random_numbers, disk
        self.killed_workers = self.killed_verbs = self.killed_schedulers = 0
        self.disk_fillings = self.farm_starts = 0
        self.statuses: list[int] = []

    @property
    def kills(self) -> int:
        return self.killed_workers + self.killed_verbs + self.killed_schedulers

    def summary(self) -> dict:
        names = (
            "kills",
            "killed_workers",
            "killed_verbs",
            "killed_schedulers",
            "disk_fillings",
            "farm_starts",
            "statuses",
        )
        return {key: getattr(self, key) for key in names}

    def run_farm(self, plan: Plan) -> bool:
        """Run a farm to its end, starting it again after each fault; return whether it succeeds."""
        while True:
            farm = subprocess.Popen(farm_command(plan), cwd=ROOT, stdout=subprocess.PIPE, text=True)
            self.farm_starts += 1
            stop_event = threading.Event()
            fault_thread = threading.Thread(target=self._inject_faults, args=(farm, stop_event))
            for line in farm.stdout:
                print(f"  {line}", end="", flush=True)
                # Only once the farm runs: while it starts, there is no work that a kill could lose.
                if " tasks to do" in line:
                    fault_thread.start()
            status = farm.wait()
            stop_event.set()
            if fault_thread.ident:
                fault_thread.join()
            self.statuses.append(status)
            if status not in (RETRY_STATUS, KILLED_STATUS):
                return status == 0
            print(f"The farm ended with status {status} and is started again.", flush=True)

    def _inject_faults(self, farm: subprocess.Popen, stop_event: threading.Event) -> None:
        while not stop_event.wait(self._random_numbers.uniform(1.5, 4)) and self.kills < self.max_kills:
            if not self.disk_fillings and self.kills >= self.max_kills // 4:
                self._fill_disk(stop_event)
            elif not self.killed_schedulers and self.kills >= self.max_kills // 2:
                self.killed_schedulers += 1
                farm.kill()
                return
            else:
                self._kill_one(farm.pid)

    def _kill_one(self, farm: int) -> None:
        """Kill a worker, or every third time a verb with its child processes, even if the verb's worker is gone."""
        verbs = [process for process in psutil.process_iter() if is_farm_process(process, self._disk)]
        workers = [process for process in children(farm) if "spawn_main" in command_line(process)]
        if verbs and self.kills % 3 == 2:
            victim = self._random_numbers.choice(verbs)
            for process in [*children(victim.pid), victim]:
                kill(process)
            self.killed_verbs += 1
        elif workers and kill(self._random_numbers.choice(workers)):
            self.killed_workers += 1

    def _fill_disk(self, stop_event: threading.Event) -> None:
        self.disk_fillings += 1
        print("The disk is full.", flush=True)
        filler_path = self._disk / "ballast"
        try:
            with open(filler_path, "wb", buffering=0) as file:
                while True:
                    file.write(bytes(1 << 20))
        except OSError as error:
            print(f"  {error.strerror}", flush=True)
        stop_event.wait(DISK_FULL_SECONDS)
        filler_path.unlink()
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
    """Return whether a process is a verb that works on this disk; its worker may have ended."""
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


def find_differences(undisturbed_plan: Plan, disturbed_plan: Plan) -> list[str]:
    """List the differences between the outputs of two farms that ran the same graph."""
    problems = []
    undisturbed_tasks, disturbed_tasks = make_tasks(undisturbed_plan), make_tasks(disturbed_plan)
    for name, task in disturbed_tasks.items():
        manifests = read_manifest(undisturbed_tasks[name]), check_outputs(task)
        if bool(manifests[0].skipped) != bool(manifests[1].skipped):
            problems.append(f"{name} was skipped in only one run")
        if task.kind in (RECORD, MERGE, REFINE) and manifests[0].outputs != manifests[1].outputs:
            problems.append(f"the recordings of {name} differ")
        if task.kind == TRAIN:
            models = [
                {path: digest for path, digest in manifest.outputs.items() if path.endswith(".onnx")}
                for manifest in manifests
            ]
            if models[0] != models[1] or len(models[0]) != 1:
                problems.append(f"the models of {name} differ")
        if task.kind in (RECORD, REFINE):
            problems += find_repeated_poses(name, task.log)
    for character in undisturbed_plan.characters:
        other = next(c for c in disturbed_plan.characters if c.name == character.name)
        digests = [hashlib.sha256((c.output / f"{c.name}.onnx").read_bytes()).digest() for c in (character, other)]
        if digests[0] != digests[1]:
            problems.append(f"the bound models of {character.name} differ")
    partial_paths = [
        path
        for path in disturbed_plan.farm.work.rglob("*")
        if is_temporary_name(path.name) or path.name.startswith((".new-", ".old-"))
    ]
    return problems + [f"a partial file was left: {path}" for path in partial_paths]


def find_repeated_poses(name: str, log: Path) -> list[str]:
    """List the restarts of a verb that recorded more poses again than a kill may lose.

    The verb prints the number of recorded poses when it starts and as it continues.
    """
    attempts = [
        [int(count) for count in re.findall(r"^poses: (\d+) of", text, re.MULTILINE)]
        for text in log.read_text().split("$ record")
    ]
    attempts = [counts for counts in attempts if counts]
    problems = []
    for before, after in itertools.pairwise(attempts):
        # The printed count includes evaluated poses that are not on the disk yet; those are evaluated again.
        if after[0] < max(before[0], before[-1] - MAX_LOST_POSES):
            problems.append(f"{name} continued from {after[0]} poses after it had recorded {before[-1]}")
    return problems


if __name__ == "__main__":
    sys.exit(main())
