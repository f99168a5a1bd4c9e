# SPDX-License-Identifier: GPL-3.0-or-later
"""Example code of the documentation runs on files that the verbs write; docs/formats.md names every key."""

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from fdda_addon.training.process import trainer_python

from ..conftest import run

pytestmark = pytest.mark.one_blender_version

ROOT = Path(__file__).resolve().parents[3]


FORMATS_PAGE = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
DEVELOPMENT_PAGE = (ROOT / "docs" / "development.md").read_text(encoding="utf-8")


def chapter(name: str) -> str:
    """Return the text of a chapter of docs/formats.md."""
    assert f"\n## {name}\n" in FORMATS_PAGE
    return FORMATS_PAGE.partition(f"\n## {name}\n")[2].partition("\n## ")[0]


def run_code(text: str, folder: Path, python: str = sys.executable, arguments: tuple[object, ...] = ()) -> str:
    """Run the only code block of a text in a folder, and return its output."""
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    code = textwrap.dedent(code)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    result = subprocess.run(
        [python, "-W", "error::RuntimeWarning", "-c", code, *map(str, arguments)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def folder(elbow_files, tmp_path_factory) -> Path:
    """Make a folder with the elbow's files under the names that the page uses."""
    folder = tmp_path_factory.mktemp("documents")
    shutil.copytree(elbow_files.recording, folder / "recording")
    (folder / "model.onnx").write_bytes(elbow_files.model.read_bytes())
    for verb, name in (("evaluate", "evaluation.json"), ("benchmark", "benchmark.json")):
        count = ("--poses", 5) if verb == "evaluate" else ("--frames", 5)
        assert run(verb, elbow_files.rig, elbow_files.model, "--json", folder / name, *count) == 0
    return folder


def test_code_of_the_recording_chapter_runs(folder):
    """The code prints the same mean distance from linear skinning in the first pose as `fdda_addon.core`."""
    from fdda_addon.core.mathematics.metrics import distances
    from fdda_addon.core.mathematics.skinning import LinearSkinning
    from fdda_addon.core.recording.reader import read_recording

    recording = read_recording(folder / "recording")
    skinning, pose = LinearSkinning(recording.rig), recording.pose_matrices[:1]
    expected = distances(recording.positions[:1], skinning.positions(pose)).mean() * 1000
    output = run_code(chapter("Recording"), folder)
    shape, value = re.fullmatch(r"(\(300, 3\)) mean distance from linear skinning (\S+) mm\n", output).groups()
    assert shape and float(value) == pytest.approx(expected, rel=1e-3)


def test_code_of_the_model_chapter_runs(folder):
    assert run_code(chapter("Model"), folder).startswith("['upper', 'lower'] (2, 300, 3) [1. ")


def test_code_of_the_evaluation_chapter_runs(folder):
    lines = run_code(chapter("Evaluation"), folder).splitlines()
    report = json.loads((folder / "evaluation.json").read_text())
    assert lines[0].startswith(f"mean {report['fdda']['mean']:.3f} mm, linear skinning ")
    assert lines[1].startswith("largest error: ")


def test_code_of_the_messages_chapter_runs(folder, tmp_path):
    shutil.copytree(folder / "recording", tmp_path / "recording")
    lines = run_code(chapter("Trainer messages"), tmp_path, trainer_python()).splitlines()
    assert len(lines) == 3 and lines[1].startswith("2/2: ") and lines[2] == "finished 0"


def test_code_of_the_development_page_runs(elbow_files, tmp_path):
    """Playback equals the model's output, and the model is nearer to the rig than linear skinning."""
    debugging = DEVELOPMENT_PAGE.partition("\n## Debugging a wrong frame\n")[2].partition("\n## ")[0]
    text = run_code(debugging, tmp_path, arguments=(elbow_files.bound, "elbow", 12))
    playback, model, linear = (
        float(distance) for distance in re.findall(r"^\w.*: ([\d.]+) at vertex", text, re.MULTILINE)
    )
    assert playback < 1e-5 and playback < model < 0.002 < linear
