# SPDX-License-Identifier: GPL-3.0-or-later
"""A farm of the elbow, small enough for a test: its plan, and its tasks done in this process one after the other."""

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
SMALL = """
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
ONE = """
[characters.elbow]
rig = "elbow.blend"
output = "out/elbow"
"""


@pytest.fixture
def written(tmp_path: Path) -> Callable[[str], Plan]:
    """Writes a plan beside the elbow's file, and reads it."""

    def write(text: str = ONE, head: str = SMALL) -> Plan:
        if not (tmp_path / "elbow.blend").exists():
            shutil.copyfile(ELBOW, tmp_path / "elbow.blend")
        path = tmp_path / "characters.toml"
        path.write_text(textwrap.dedent(head + text))
        return read_plan(path)

    return write


def do_all(plan: Plan, kinds: tuple[str, ...] = KINDS) -> dict[str, Outcome]:
    """All tasks of a plan, or those of some kinds, in this process."""
    tasks = make_tasks(plan)
    return {name: run_task(plan.farm, tasks, name) for name, task in tasks.items() if task.kind in kinds}


def states(outcomes: dict[str, Outcome]) -> dict[str, str]:
    return {name: outcome.state for name, outcome in outcomes.items()}


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, by path."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
