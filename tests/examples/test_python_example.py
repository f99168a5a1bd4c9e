# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python example computes the same poses as Blender and the same shapes as the add-on, and reports errors."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.formats.model import read_model_info

from .conftest import CONTROL, PIPE_VERTICES, ROOT, Character, expected_positions

EXAMPLE = ROOT / "examples" / "python" / "play.py"
ROTATIONS = {"bone_0": (10.0, -70.0, 5.0), "bone_1": (40.0, 25.0, -30.0), "bone_3": (0.0, 0.0, 50.0)}
TURN_OPTIONS = [text for name, angles in ROTATIONS.items() for text in ("--turn", name, *map(str, angles))]
CONTROL_NAME = f"{CONTROL.owner}/{CONTROL.path}"


def run_example(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run the example in a folder. With -I it cannot import the add-on."""
    command = [sys.executable, "-I", str(EXAMPLE), *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def run_and_load(folder: Path, model: Path, *arguments: object) -> np.ndarray:
    """Run the example and return the positions that it writes, (V, 3)."""
    result = run_example(folder, model, "posed.npy", *arguments)
    assert result.returncode == 0, result.stderr
    return np.load(folder / "posed.npy", allow_pickle=False)


def read_obj(path: Path) -> tuple[np.ndarray, list[list[int]]]:
    rows = [line.split() for line in path.read_text().splitlines()]
    vertices = [list(map(float, row[1:])) for row in rows if row[0] == "v"]
    return np.array(vertices), [[int(corner) - 1 for corner in row[1:]] for row in rows if row[0] == "f"]


def test_rotations_match_those_of_blender_and_the_default_is_the_rest_pose(chain: Character, tmp_path: Path):
    positions = run_and_load(tmp_path, chain.model, *TURN_OPTIONS)
    assert np.abs(positions - expected_positions(chain.model, ROTATIONS)).max() < 1e-5
    assert np.abs(positions - expected_positions(chain.model, {})).max() > 0.1
    assert np.abs(run_and_load(tmp_path, chain.model) - expected_positions(chain.model, {})).max() < 1e-5


def test_the_obj_file_has_the_faces_of_the_recording(chain: Character, tmp_path: Path):
    result = run_example(tmp_path, chain.model, "posed.obj", *TURN_OPTIONS, "--recording", chain.recording)
    assert result.returncode == 0, result.stderr
    vertices, faces = read_obj(tmp_path / "posed.obj")
    assert np.abs(vertices - expected_positions(chain.model, ROTATIONS)).max() < 1e-5
    recorded_faces = np.load(chain.recording / "face_vertices.npy").reshape(-1, 3)
    assert faces == recorded_faces.tolist()


def test_several_meshes_are_objects_of_the_obj_file(controlled_chain: Character, tmp_path: Path):
    recording = controlled_chain.recording
    assert run_example(tmp_path, controlled_chain.model, "a.obj", "--recording", recording).returncode == 0
    pipe, hose = (tmp_path / "a.obj").read_text().removeprefix("o pipe\n").split("o hose\n")
    assert (pipe.count("v "), hose.count("v ")) == (PIPE_VERTICES, 90 - PIPE_VERTICES)
    corners = [{int(corner) for line in re.findall("f (.*)", text) for corner in line.split()} for text in (pipe, hose)]
    assert 0 < min(corners[0]) < max(corners[0]) <= PIPE_VERTICES < min(corners[1]) < max(corners[1]) <= 90


def test_the_code_of_the_page_divides_the_meshes(controlled_chain: Character, tmp_path: Path):
    page = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8").partition("### Running a model\n")[2]
    (tmp_path / "model.onnx").symlink_to(controlled_chain.model)
    code = page.partition("```python\n")[2].partition("```")[0]
    command = [sys.executable, "-I", "-c", code + "\nprint(*own[0, 0], *positions[0, 40])"]
    lines = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.splitlines()
    assert [line.partition(") ")[0] for line in lines[1:3]] == ["pipe (2, 40, 3", "hose (2, 50, 3"]
    x, y, z, *first = map(float, lines[3].split())
    assert (x, y, z + 0.5) == pytest.approx(first, abs=1e-6)


def test_the_confidence_is_printed_and_falls_outside_the_trained_range(chain: Character, tmp_path: Path):
    inside = run_example(tmp_path, chain.model, "a.obj", "--turn", "bone_1", 20, 0, 0)
    turns = [option for bone in ("bone_1", "bone_2") for option in ("--turn", bone, 170, 0, 0)]
    outside = run_example(tmp_path, chain.model, "a.obj", *turns)
    assert inside.stdout == "a.obj: 90 vertices, confidence 1.00\n"
    assert float(outside.stdout.removeprefix("a.obj: 90 vertices, confidence ")) < 0.9


@pytest.mark.parametrize("is_set", [False, True])
def test_a_control_that_is_not_set_has_its_value_nearest_to_zero(
    controlled_chain: Character, tmp_path: Path, is_set: bool
):
    low = read_model_info(controlled_chain.model).controls[0].low
    assert low > 0.2
    value, other_value = (0.9, low) if is_set else (low, 0.9)
    positions = run_and_load(
        tmp_path, controlled_chain.model, *TURN_OPTIONS, *(["--extra-input", CONTROL_NAME, value] if is_set else [])
    )
    assert np.abs(positions - expected_positions(controlled_chain.model, ROTATIONS, (value,))).max() < 1e-5
    assert np.abs(positions - expected_positions(controlled_chain.model, ROTATIONS, (other_value,))).max() > 5e-3


def test_vertices_without_a_bone_do_not_move(controlled_chain: Character, tmp_path: Path):
    is_static_vertex = np.load(controlled_chain.recording / "rest_positions.npy")[:, 2] < 0.15
    posed_positions = run_and_load(tmp_path, controlled_chain.model, "--turn", "bone_0", 30, 0, 0)
    moved_distances = np.linalg.norm(posed_positions - run_and_load(tmp_path, controlled_chain.model), axis=1)
    assert moved_distances[is_static_vertex].max() < 1e-5 and np.median(moved_distances[~is_static_vertex]) > 0.05


def test_unknown_joints_and_controls_are_reported_in_one_sentence(
    chain: Character, controlled_chain: Character, tmp_path: Path
):
    output_path = tmp_path / "model.npy"
    for arguments, sentence in (
        (["--turn", "elbow", 1, 2, 3], "The model has no joint elbow; it has: bone_0, bone_1, bone_2, bone_3."),
        (["--turn", "", 1, 2, 3], "The model has no joint ''; it has: bone_0, bone_1, bone_2, bone_3."),
        (["--extra-input", "smile", 1], "The model has no control smile; it has: none."),
    ):
        result = run_example(tmp_path, chain.model, output_path, *arguments)
        assert (result.returncode, result.stderr, output_path.exists()) == (1, sentence + "\n", False)
    result = run_example(tmp_path, controlled_chain.model, output_path, "--extra-input", "smile", 1)
    assert result.stderr == f"The model has no control smile; it has: {CONTROL_NAME}.\n"


def test_invalid_numbers_and_model_files_are_named(chain: Character, tmp_path: Path):
    result = run_example(tmp_path, chain.model, "posed.obj", "--turn", "bone_1", 1, "two", 3)
    assert result.returncode == 2 and result.stderr.endswith("could not convert string to float: 'two'\n")
    (tmp_path / "text.onnx").write_text("no model")
    result = run_example(tmp_path, "text.onnx", "posed.obj")
    assert result.returncode == 1 and "Traceback" not in result.stderr
    assert result.stderr.startswith("ONNX Runtime cannot load text.onnx; choose a model that 'train' has written.")


def test_a_recording_of_a_different_mesh_is_refused(chain: Character, tmp_path: Path):
    recording = tmp_path / "other"
    recording.mkdir()
    result = run_example(tmp_path, chain.model, "posed.obj", "--recording", recording)
    assert result.returncode == 1
    assert (
        result.stderr == f"{recording} is not a recording with faces; record the rig again, or leave out --recording.\n"
    )
    (recording / "face_starts.npy").symlink_to(chain.recording / "face_starts.npy")
    text = (chain.recording / "recording.json").read_text()
    assert '"chain"' in text
    (recording / "recording.json").write_text(text.replace('"chain"', '"tube"'))
    result = run_example(tmp_path, chain.model, "posed.obj", "--recording", recording)
    assert (
        result.stderr
        == f"{recording} is a recording of a different mesh; choose the one that the model was trained on.\n"
    )
