# SPDX-License-Identifier: GPL-3.0-or-later
"""Random poses in the overshoot around the range of motion, of a rig whose own limits do not clamp them."""

import json
import math
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
import pytest

from fdda_addon.core.mathematics.skinning import skin_matrices
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from ..conftest import run, train
from ..scene_state import drain, fresh_elbow

pytestmark = pytest.mark.one_blender_version

SETTINGS = RecordingSettings(poses=40, overshoot=2.0, influence_poses=2, actions=("elbow_wave",))
INSIDE = 30
"""Number of random poses inside the range of motion. They come first, and the other 10 are in the overshoot."""


@pytest.fixture
def rig(tmp_path) -> Path:
    for bone in fresh_elbow().armature_object.pose.bones:
        for constraint in bone.constraints:
            constraint.influence = 0.0
    save_copy(tmp_path / "elbow.blend")
    return tmp_path / "elbow.blend"


def opened(rig: Path) -> SceneRig:
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    return find_rig()


def recorded(rig: Path, path: Path, settings: RecordingSettings = SETTINGS) -> Recording:
    drain(record(opened(rig), path, settings))
    return read_recording(path)


def bends(recording: Recording) -> np.ndarray:
    """Return the rotation of the lower bone relative to the upper bone, in axes of the lower bone, (N, 3, 3)."""
    rig = recording.rig
    skin = skin_matrices(np.array(recording.pose_matrices, np.float64), rig.rest_matrices.astype(np.float64))
    rest = rig.rest_matrices[1, :3, :3].astype(np.float64)
    return rest.T @ np.linalg.inv(skin[:, 0, :3, :3]) @ skin[:, 1, :3, :3] @ rest


def angles(rotations: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1)))


def test_poses_of_the_overshoot_leave_the_limits_and_locked_axes(rig, tmp_path):
    recording = recorded(rig, tmp_path / "r")
    overshoot = recording.info.sampling.overshoot
    assert (overshoot.factor, overshoot.poses) == (2.0, 10)
    own, turned = recording.info.sampling.channels, bends(recording)
    (bend,) = (c for c in own if c.name == "lower")
    # Inside the range of motion the bone rotates about one axis only; in the overshoot it rotates about all axes.
    about = np.eye(3)[bend.axis]
    off_axis = np.degrees(np.arccos(np.clip(turned @ about @ about, -1, 1)))
    assert off_axis[:INSIDE].max() < 0.1 < 5 < off_axis[INSIDE : SETTINGS.poses].max()
    middle, half = (bend.low + bend.high) / 2, (bend.high - bend.low) / 2
    assert angles(turned)[:INSIDE].max() <= math.degrees(middle + half) + 0.1
    assert angles(turned)[INSIDE : SETTINGS.poses].max() > math.degrees(middle + half) + 5


def test_poses_inside_and_frames_are_those_of_a_recording_without_an_overshoot(rig, tmp_path):
    without = recorded(rig, tmp_path / "without", replace(SETTINGS, overshoot=1.0))
    recording = recorded(rig, tmp_path / "with")
    for name in ("pose_matrices", "positions"):
        ours, theirs = np.array(getattr(recording, name)), np.array(getattr(without, name))
        assert np.array_equal(ours[:INSIDE], theirs[:INSIDE])
        assert np.array_equal(ours[SETTINGS.poses :], theirs[SETTINGS.poses :])
    assert without.info.sampling.overshoot is None
    assert recording.info.sampling.channels == without.info.sampling.channels


def test_record_accepts_overshoots_from_1_to_4(rig, tmp_path, capfd):
    assert run("record", rig, tmp_path / "r", "--poses", 20, "--overshoot", 1.5) == 0
    overshoot = read_recording(tmp_path / "r").info.sampling.overshoot
    assert (overshoot.factor, overshoot.poses) == (1.5, 5)
    for value in ("0.5", "4.5", "nan"):
        assert run("record", rig, tmp_path / "s", "--overshoot", value) == 2
        assert f"--overshoot: must be a number, 1 or more and at most 4, not '{value}'" in capfd.readouterr().err
    assert not (tmp_path / "s").exists()


def test_an_overshoot_at_least_halves_the_error_beyond_the_range(rig, tmp_path):
    errors = {}
    for overshoot in ("1", "2"):
        recording, model, out = tmp_path / overshoot, tmp_path / f"{overshoot}.onnx", tmp_path / f"{overshoot}.json"
        assert run("record", rig, recording, "--poses", 200, "--overshoot", overshoot) == 0
        train(recording, model, "--passes", 60)
        assert run("evaluate", rig, model, "--json", out, "--poses", 40, "--range-scale", 2) == 0
        errors[overshoot] = _errors(out)
    assert errors["2"][1] < errors["1"][1] / 2
    assert errors["2"][0] < 1.5 * errors["1"][0]


def _errors(path: Path) -> tuple[float, float]:
    """Return the mean error inside the range of motion and the mean error at twice the range, mm."""
    found = json.loads(path.read_text())
    return found["fdda"]["mean"], found["scaled_ranges"][0]["fdda"]["mean"]
