# SPDX-License-Identifier: GPL-3.0-or-later
"""A short run of `benchmarks/soak.py`, from seeds that its own runs do not use."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from .conftest import run

pytestmark = pytest.mark.one_blender_version

ROOT = Path(__file__).resolve().parents[2]
SEED = 77
NEAR_THE_RIG = {"mode": 40, "topology": 40, "controls": 20}
"""Parts that compare with the rig, and how many cases; the others compare with the model."""


@pytest.fixture(scope="module")
def folder(elbow, tmp_path_factory) -> Path:
    """What the soak prepares, from the elbow that is there."""
    folder = tmp_path_factory.mktemp("soak")
    for name, path in (("elbow.blend", elbow.rig), ("elbow.onnx", elbow.model), ("bound.blend", elbow.bound)):
        (folder / name).write_bytes(path.read_bytes())
    shutil.copytree(elbow.recording, folder / "recording")
    assert run("record", elbow.rig, folder / "short recording", "--poses", 40) == 0
    return folder


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="The soak measures memory by /proc, which only Linux has.")
@pytest.mark.parametrize(
    ("part", "count"),
    [
        ("models", 60), ("kills", 3), ("disks", 4), ("outputs", 12), ("frames", 200), ("undo", 40), ("loads", 6),
        ("time", 8), ("armatures", 6), *NEAR_THE_RIG.items(),
    ],
)  # fmt: skip
def test_a_short_soak(folder, part, count):
    from benchmarks.soaking.cases import FELL_SHORT, heard
    from benchmarks.soaking.changes import NEAR

    if part in ("kills", "disks") and not can_train():
        pytest.skip("the environment of this line has no torch")
    script = ROOT / "benchmarks" / "soak.py"
    command = [sys.executable, script, folder, "--seed", str(SEED), "--work", part, "0", str(count)]
    result = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False, timeout=200)
    cases = [case for line in result.stdout.splitlines() if (case := heard(line))]
    assert [case for case in cases if case.outcome == FELL_SHORT] == []
    assert len(cases) == count and result.returncode == 0, result.stderr[-2000:]
    assert max(case.off for case in cases) <= (NEAR if part in NEAR_THE_RIG else 0)


def can_train() -> bool:
    return subprocess.run([sys.executable, "-c", "import torch"], capture_output=True, check=False).returncode == 0


ODD_PROCESS = """
import json, sys, time
place = int(sys.argv[-2])
case = {"part": "p", "name": "", "outcome": "held", "text": "", "seconds": 0, "peak_mb": 0, "memory_mb": 0, "off": 0}
for number in range(place, int(sys.argv[-1])):
    if number == 1:
        sys.exit(-11)
    if number == 2:
        time.sleep(60)
    print("soak: " + json.dumps(case | {"outcome": "fell short" if number == 3 else "held"}), flush=True)
"""


def test_a_process_that_dies_and_one_that_hangs_are_cases(tmp_path, monkeypatch):
    from benchmarks import soak

    script = tmp_path / "odd.py"
    script.write_text(ODD_PROCESS)
    monkeypatch.setattr(soak, "__file__", str(script))
    monkeypatch.setattr(soak, "START_TIMEOUT_SECONDS", 3)
    heard = []
    soak.watch_part(soak.SoakPart("models", 5, 5), tmp_path, 0, heard.append)
    assert [case.outcome for case in heard] == ["held", "fell short", "fell short", "fell short", "held"]
    assert "ended" in heard[1].text and "hung" in heard[2].text
    assert "| p | 3 | 0 | 2 | 1 |" in soak.table(heard)


def test_mutations_follow_from_the_seed(elbow):
    import numpy as np

    from benchmarks.soaking.models import mutated

    data = elbow.model.read_bytes()
    first, again, other = (
        [mutated(np.random.default_rng((seed, number)), data) for number in range(20)] for seed in (1, 1, 2)
    )
    assert first == again and first != other
