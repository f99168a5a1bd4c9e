# SPDX-License-Identifier: GPL-3.0-or-later
"""Limits for the errors of the demo, which records, trains, evaluates and binds the arm; and its files."""

import json
from pathlib import Path

import bpy
import numpy as np
import pytest

from benchmarks import demo

from ..conftest import assert_plays

pytestmark = [pytest.mark.one_blender_version, pytest.mark.slow]

MAX_MEAN_RATIO, MAX_P999_RATIO, MAX_MAX_RATIO = 0.012, 0.03, 0.15
"""Limits for the model's errors on held-out poses, as ratios of the errors of linear skinning."""
MAX_SCALED_RANGE_RATIOS = {"1.5": 0.03, "2": 0.06, "3": 0.2}
"""Limits for the ratio of mean errors, by the factor that scales the range of motion."""
MAX_EXTREME_POSE_RATIOS = {"elbow 3x its range, off its axis": 0.45, "metacarpals 2.5x their range": 0.15}
"""Limits for the ratio of mean errors, by the name of an action with one pose."""


@pytest.fixture(scope="module")
def demo_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the demo, and return its folder."""
    import fdda_addon

    folder = tmp_path_factory.mktemp("demo")
    fdda_addon.register()
    try:
        assert demo.main(folder) == 0
    finally:
        fdda_addon.unregister()
    return folder


@pytest.fixture(scope="module")
def errors(demo_folder: Path) -> dict:
    return json.loads((demo_folder / "evaluation.json").read_text())


def test_the_demo_writes_its_files(demo_folder):
    assert {path.name for path in demo_folder.iterdir()} == {
        *("arm.blend", "recording", "arm.onnx", "arm.checkpoint.npz", "report.json", "report.html"),
        *("evaluation.json", "arm_bound.blend", "pictures"),
    }


def test_errors_on_held_out_poses_are_small(errors):
    assert errors["poses"] == 200
    assert errors["fdda"]["mean"] <= MAX_MEAN_RATIO * errors["linear"]["mean"]
    assert errors["fdda"]["p999"] <= MAX_P999_RATIO * errors["linear"]["p999"]
    assert errors["fdda"]["max"] <= MAX_MAX_RATIO * errors["linear"]["max"]


def test_errors_outside_the_range_of_motion_are_small(errors):
    assert [e["name"] for e in errors["scaled_ranges"]] == [
        "1.5 times the range",
        "2 times the range",
        "3 times the range",
    ]
    limits = {f"{factor} times the range": limit for factor, limit in MAX_SCALED_RANGE_RATIOS.items()}
    limits |= MAX_EXTREME_POSE_RATIOS
    for poses in (*errors["scaled_ranges"], *errors["actions"][1:]):
        assert poses["fdda"]["mean"] < limits[poses["name"]] * poses["linear"]["mean"], poses["name"]
        # A vertex is at most slightly further from the rig than with linear skinning alone.
        assert poses["fdda"]["max"] < 1.05 * poses["linear"]["max"], poses["name"]


def test_the_model_improves_every_partition(errors):
    for partition in errors["partitions"]:
        assert partition["fdda"]["mean"] < 0.25 * partition["linear"]["mean"], partition["joint"]


def test_pictures_are_not_empty(demo_folder):
    pictures = sorted((demo_folder / "pictures").iterdir())
    assert len(pictures) == 5
    for picture in pictures:
        image = bpy.data.images.load(str(picture))
        pixels = np.array(image.pixels[:]).reshape(-1, image.channels)[:, :3]
        assert len(np.unique(pixels.round(2), axis=0)) > 50, picture.name


def test_the_report_loads_no_other_files(demo_folder):
    page = (demo_folder / "report.html").read_text()
    assert 'src="http' not in page and 'href="http' not in page


def test_the_bound_file_plays(demo_folder):
    bpy.ops.wm.open_mainfile(filepath=str(demo_folder / "arm_bound.blend"))
    mesh_object = bpy.data.objects["arm"]
    for frame in (1, 76, 132, 240):
        bpy.context.scene.frame_set(frame)
        assert_plays(mesh_object, demo_folder / "arm.onnx")
