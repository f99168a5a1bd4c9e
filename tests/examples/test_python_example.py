# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python example poses as Blender does, plays as the add-on does, and says what is wrong in a sentence."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.model import read_model_info

from .conftest import CONTROL, ROOT, Character, expected_positions

EXAMPLE = ROOT / "examples" / "python" / "play.py"
TURNS = {"bone_0": (10.0, -70.0, 5.0), "bone_1": (40.0, 25.0, -30.0), "bone_3": (0.0, 0.0, 50.0)}
TURNED = [text for name, angles in TURNS.items() for text in ("--turn", name, *map(str, angles))]
NAME = f"{CONTROL.owner}/{CONTROL.path}"


def play(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the example in a folder; -I keeps the add-on's folder from the packages that it could import."""
    command = [sys.executable, "-I", str(EXAMPLE), *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def played(folder: Path, model: Path, *arguments: object) -> np.ndarray:
    """(V, 3), the array that the example writes."""
    result = play(folder, model, "posed.npy", *arguments)
    assert result.returncode == 0, result.stderr
    return np.load(folder / "posed.npy", allow_pickle=False)


def read_obj(path: Path) -> tuple[np.ndarray, list[list[int]]]:
    rows = [line.split() for line in path.read_text().splitlines()]
    vertices = [list(map(float, row[1:])) for row in rows if row[0] == "v"]
    return np.array(vertices), [[int(corner) - 1 for corner in row[1:]] for row in rows if row[0] == "f"]


def test_it_poses_as_blender_does(chain: Character, tmp_path: Path):
    positions = played(tmp_path, chain.model, *TURNED)
    assert np.abs(positions - expected_positions(chain.model, TURNS)).max() < 1e-5
    assert np.abs(positions - expected_positions(chain.model, {})).max() > 0.1


def test_without_turns_it_is_the_rest_pose(chain: Character, tmp_path: Path):
    assert np.abs(played(tmp_path, chain.model) - expected_positions(chain.model, {})).max() < 1e-5


def test_it_writes_faces(chain: Character, tmp_path: Path):
    result = play(tmp_path, chain.model, "posed.obj", *TURNED, "--recording", chain.recording)
    assert result.returncode == 0, result.stderr
    vertices, faces = read_obj(tmp_path / "posed.obj")
    assert np.abs(vertices - expected_positions(chain.model, TURNS)).max() < 1e-5
    recorded = np.load(chain.recording / "face_vertices.npy").reshape(-1, 3)
    assert faces == recorded.tolist()


def test_it_says_how_far_the_model_is_to_be_believed(chain: Character, tmp_path: Path):
    inside, outside = (play(tmp_path, chain.model, "a.obj", "--turn", "bone_1", angle, 0, 0) for angle in (20, 170))
    assert inside.stdout == "a.obj: 90 vertices, confidence 1.00\n"
    assert float(outside.stdout.removeprefix("a.obj: 90 vertices, confidence ")) < 0.9


@pytest.mark.parametrize("given", [False, True])
def test_a_control_that_is_not_given_is_as_near_to_zero_as_it_may(controlled: Character, tmp_path: Path, given: bool):
    low = read_model_info(controlled.model).controls[0].low
    assert low > 0.2
    value, other = (0.9, low) if given else (low, 0.9)
    positions = played(tmp_path, controlled.model, *TURNED, *(["--control", NAME, value] if given else []))
    assert np.abs(positions - expected_positions(controlled.model, TURNS, (value,))).max() < 1e-5
    assert np.abs(positions - expected_positions(controlled.model, TURNS, (other,))).max() > 5e-3


def test_what_follows_no_bone_stays(controlled: Character, tmp_path: Path):
    still = np.load(controlled.recording / "rest_positions.npy")[:, 2] < 0.15
    posed = played(tmp_path, controlled.model, "--turn", "bone_0", 30, 0, 0)
    moved = np.linalg.norm(posed - played(tmp_path, controlled.model), axis=1)
    assert moved[still].max() < 1e-5 and np.median(moved[~still]) > 0.05


def test_bad_input_ends_with_one_sentence(chain: Character, controlled: Character, tmp_path: Path):
    other = tmp_path / "model.npy"
    for arguments, sentence in (
        (["--turn", "elbow", 1, 2, 3], "The model has no joint elbow; it has: bone_0, bone_1, bone_2, bone_3."),
        (["--turn", "", 1, 2, 3], "The model has no joint ''; it has: bone_0, bone_1, bone_2, bone_3."),
        (["--control", "smile", 1], "The model has no control smile; it has: none."),
    ):
        result = play(tmp_path, chain.model, other, *arguments)
        assert (result.returncode, result.stderr, other.exists()) == (1, sentence + "\n", False)
    result = play(tmp_path, controlled.model, other, "--control", "smile", 1)
    assert result.stderr == f"The model has no control smile; it has: {NAME}.\n"


def test_numbers_and_files_that_are_none_are_named(chain: Character, tmp_path: Path):
    result = play(tmp_path, chain.model, "posed.obj", "--turn", "bone_1", 1, "two", 3)
    assert result.returncode == 2 and result.stderr.endswith("could not convert string to float: 'two'\n")
    (tmp_path / "text.onnx").write_text("no model")
    result = play(tmp_path, "text.onnx", "posed.obj")
    assert result.returncode == 1 and "Traceback" not in result.stderr
    assert result.stderr.startswith("ONNX Runtime cannot load text.onnx; name a model that 'train' has written.")


def test_a_recording_of_another_mesh_is_refused(chain: Character, tmp_path: Path):
    recording = tmp_path / "other"
    recording.mkdir()
    result = play(tmp_path, chain.model, "posed.obj", "--recording", recording)
    assert result.returncode == 1
    assert result.stderr == f"{recording} is no recording with faces; record the rig again, or leave --recording out.\n"
    (recording / "face_starts.npy").symlink_to(chain.recording / "face_starts.npy")
    text = (chain.recording / "recording.json").read_text()
    assert '"chain"' in text
    (recording / "recording.json").write_text(text.replace('"chain"', '"tube"'))
    result = play(tmp_path, chain.model, "posed.obj", "--recording", recording)
    assert result.stderr == f"{recording} is a recording of another mesh; name the one that the model was trained on.\n"


def test_the_command_of_the_page_runs_as_it_is_written(chain: Character, tmp_path: Path):
    """In a folder as after `make demo`, with the chain in place of the arm."""
    page = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"^    (python examples/python/.*)$", page, re.MULTILINE)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "out" / "demo").mkdir(parents=True)
    (tmp_path / "out" / "demo" / "arm.onnx").symlink_to(chain.model)
    (tmp_path / "out" / "demo" / "recording").symlink_to(chain.recording)
    arguments = shlex.split(command.replace(" elbow ", " bone_1 "))
    result = subprocess.run([sys.executable, *arguments[1:]], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert len(read_obj(tmp_path / "posed.obj")[1]) == 88
