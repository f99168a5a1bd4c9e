# SPDX-License-Identifier: GPL-3.0-or-later
"""Plans of a small farm with the elbow, and functions that run their tasks in this process."""

import shutil
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

from farm.characters import Plan, read_plan
from farm.run import Outcome, run_task
from farm.tasks import KINDS, make_tasks

ROOT = Path(__file__).resolve().parents[2]
ELBOW = ROOT / "blend_fixtures" / "elbow.blend"
SMALL_SETTINGS = """
[farm]
retry_seconds = 0.1
pictures = false
[defaults]
poses = 20
shards = 2
evaluate_poses = 4
refine_poses = 6
train = { epochs = 2, hidden = [8] }
"""
ONE_CHARACTER = """
[characters.elbow]
rig = "elbow.blend"
output = "out/elbow"
"""


@pytest.fixture
def write_plan(tmp_path: Path) -> Callable[[str], Plan]:
    """Return a function that writes a plan beside a copy of the elbow's file and reads it."""

    def write(characters: str = ONE_CHARACTER, settings: str = SMALL_SETTINGS) -> Plan:
        if not (tmp_path / "elbow.blend").exists():
            shutil.copyfile(ELBOW, tmp_path / "elbow.blend")
        path = tmp_path / "characters.toml"
        path.write_text(textwrap.dedent(settings + characters))
        return read_plan(path)

    return write


def run_tasks(plan: Plan, kinds: tuple[str, ...] = KINDS) -> dict[str, Outcome]:
    """Run the tasks of a plan, or those of some kinds, in this process; return their outcomes by name."""
    tasks = make_tasks(plan)
    return {name: run_task(plan.farm, tasks, name) for name, task in tasks.items() if task.kind in kinds}


def states_by_task(outcomes: dict[str, Outcome]) -> dict[str, str]:
    """Return the state of each outcome by the name of its task."""
    return {name: outcome.state for name, outcome in outcomes.items()}


def read_all_files(folder: Path) -> dict[str, bytes]:
    """Read all files below a folder, by relative path."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
