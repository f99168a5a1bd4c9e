# SPDX-License-Identifier: GPL-3.0-or-later
"""A short run of `benchmarks/soak.py` with a seed that is not its default."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from .conftest import run

pytestmark = pytest.mark.one_blender_version

ROOT = Path(__file__).resolve().parents[2]
SEED = 77


@pytest.fixture(scope="module")
def soak_folder(elbow_files, tmp_path_factory) -> Path:
    """Return a folder with the files that the soak test builds first, copied from the elbow fixture."""
    folder = tmp_path_factory.mktemp("soak")
    for name, path in (
        ("elbow.blend", elbow_files.rig),
        ("elbow.onnx", elbow_files.model),
        ("bound.blend", elbow_files.bound),
    ):
        (folder / name).write_bytes(path.read_bytes())
    shutil.copytree(elbow_files.recording, folder / "recording")
    assert run("record", elbow_files.rig, folder / "short recording", "--poses", 40) == 0
    return folder


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="The soak measures memory by /proc, which only Linux has.")
@pytest.mark.parametrize(("part", "count"), [("models", 60), ("recordings", 60), ("kills", 3), ("disks", 4)])
def test_no_case_of_a_short_soak_fails(soak_folder, part, count):
    from benchmarks.soaking.cases import FAILED, parse_case

    if part in ("kills", "disks") and not can_train():
        pytest.skip("the environment of this line has no torch")
    script = ROOT / "benchmarks" / "soak.py"
    command = [sys.executable, script, soak_folder, "--seed", str(SEED), "--work", part, "0", str(count)]
    result = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False, timeout=200)
    cases = [case for line in result.stdout.splitlines() if (case := parse_case(line))]
    assert [case for case in cases if case.outcome == FAILED] == []
    assert len(cases) == count and result.returncode == 0, result.stderr[-2000:]
    assert all(case.error_m == 0 for case in cases)


def can_train() -> bool:
    return subprocess.run([sys.executable, "-c", "import torch"], capture_output=True, check=False).returncode == 0


CRASHING_SCRIPT = """
import json, sys, time
case = {"part": "p", "name": "", "outcome": "passed", "text": "", "seconds": 0, "peak_mb": 0, "memory_mb": 0}
for case_index in range(int(sys.argv[-2]), int(sys.argv[-1])):
    if case_index == 1:
        sys.exit(-11)
    if case_index == 2:
        time.sleep(60)
    print("soak: " + json.dumps(case | {"outcome": "failed" if case_index == 3 else "passed"}), flush=True)
"""


def test_a_crashed_and_a_hanging_process_count_as_failed_cases(tmp_path, monkeypatch):
    from benchmarks import soak

    script = tmp_path / "odd.py"
    script.write_text(CRASHING_SCRIPT)
    monkeypatch.setattr(soak, "__file__", str(script))
    monkeypatch.setattr(soak, "START_TIMEOUT_SECONDS", 3)
    cases = []
    soak.watch_part(soak.SoakPart("models", 5, 5), tmp_path, 0, cases.append)
    assert [case.outcome for case in cases] == ["passed", "failed", "failed", "failed", "passed"]
    assert "ended" in cases[1].text and "hung" in cases[2].text
    assert "| p | 3 | 0 | 2 | 1 |" in soak.format_table(cases)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no user IDs.")
def test_only_root_runs_the_part_of_full_disks_unless_it_is_named(monkeypatch, capsys):
    import os

    from benchmarks import soak

    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert soak.select_parts(None) == list(soak.SOAK_PARTS)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    selected = soak.select_parts(None)
    assert [part.name for part in soak.SOAK_PARTS if part not in selected] == ["disks"]
    assert capsys.readouterr().out == "disks: left out, only root can mount a disk\n"
    assert [part.name for part in soak.select_parts(["disks"])] == ["disks"]


def test_the_seed_determines_the_mutations(elbow_files):
    import numpy as np

    from benchmarks.soaking.models import mutate_model

    data = elbow_files.model.read_bytes()
    models, same_seed_models, other_seed_models = (
        [mutate_model(np.random.default_rng((seed, case_index)), data) for case_index in range(20)]
        for seed in (1, 1, 2)
    )
    assert models == same_seed_models and models != other_seed_models
