# SPDX-License-Identifier: GPL-3.0-or-later
"""Targets that depend on time: frames are recorded in order, with a pre-roll, or poses are held until they settle."""

import json
import subprocess
import sys
import time
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import targets
from blend_fixtures.elbow import ACTION, FRAMES
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.rig.pose_setter import TargetSettings
from fdda_addon.scene.scene_rig import find_rig

from ... import systems
from ..conftest import evaluated_positions, run, train
from ..scene_state import assert_same_state, drain, scene_state
from .test_target_refusals import refused
from .test_targets import built, of_flesh, recorded, residuals

SIMULATIONS = (targets.target_soft_body, targets.target_cloth, targets.target_geometry_nodes)
ROOT = Path(__file__).resolve().parents[3]
SLOW_SIMULATIONS = [pytest.param(build, marks=pytest.mark.slow) for build in SIMULATIONS[:2]]
SETTLED = ("--learn-from", "flesh", "--settle-frames", 80)


def played(rig: Path) -> np.ndarray:
    """(F, V, 3), what the flesh shows when the action plays from the first frame, as a user plays it."""
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    found = []
    for frame in range(1, FRAMES + 1):
        bpy.context.scene.frame_set(frame)
        found.append(evaluated_positions(bpy.data.objects["flesh"]))
    return np.stack(found)


@pytest.mark.parametrize("build", SIMULATIONS)
def test_a_recorded_simulation_equals_its_playback(build, tmp_path):
    rig = built(build, tmp_path / "rig.blend")
    recording = of_flesh(rig, tmp_path / "recording")
    assert recording.info.target.follows == "simulation"
    assert np.abs(recording.positions - played(rig)).max() < 1e-5
    # In the second recording, the simulation still caches the frames of the first one.
    again = of_flesh(rig, tmp_path / "again")
    assert np.array_equal(recording.positions, again.positions)


def test_frames_of_a_cache_before_the_action_are_simulated(tmp_path):
    def start_earlier() -> None:
        targets.target_soft_body().modifiers["Softbody"].point_cache.frame_start = -9

    early = of_flesh(built(start_earlier, tmp_path / "early.blend"), tmp_path / "early")
    late = of_flesh(built(targets.target_soft_body, tmp_path / "late.blend"), tmp_path / "late")
    # The flesh sags during the ten earlier frames in the first pose.
    lengths = [np.linalg.norm(residuals(recording)[0], axis=1).max() for recording in (early, late)]
    assert lengths[0] > 0.003 and lengths[1] < 1e-5


@pytest.mark.parametrize("build", SIMULATIONS[:2])
def test_a_pre_roll_moves_from_the_rest_pose_to_the_first_pose(build, tmp_path):
    rig = built(build, tmp_path / "rig.blend")
    recording = of_flesh(rig, tmp_path / "recording", "--pre-roll", 20)
    assert recording.info.target.pre_roll == 20
    without = of_flesh(rig, tmp_path / "without")
    assert np.array_equal(recording.pose_matrices, without.pose_matrices)
    assert np.linalg.norm(residuals(recording)[0], axis=1).max() > 0.001
    assert np.linalg.norm(residuals(without)[0], axis=1).max() < 1e-5
    # The pre-roll begins in the rest pose, so the current pose does not matter.
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    before = scene_state(find_rig("elbow"))
    settings = RecordingSettings(poses=0, actions=(ACTION,), target=TargetSettings("flesh", pre_roll=20))
    drain(record(find_rig("elbow"), tmp_path / "third", settings))
    assert_same_state(before, scene_state(find_rig("elbow")))
    cache = bpy.data.objects["flesh"].modifiers[-1].point_cache
    assert (cache.frame_start, cache.frame_end) == (1, 250)
    assert np.array_equal(read_recording(tmp_path / "third").positions, recording.positions)


def test_a_pre_roll_of_geometry_nodes_before_frame_0_is_refused(refusal, tmp_path):
    rig = built(targets.target_geometry_nodes, tmp_path / "rig.blend")
    assert refused(refusal, rig, "--pre-roll", 5) == (
        f"A pre-roll of 5 frames before frame 1 of '{ACTION}' begins before frame 0, where Blender simulates no "
        "Geometry Nodes; move the action to later frames."
    )


def test_frames_outside_a_simulation_are_refused(refusal, tmp_path):
    def end_early() -> None:
        targets.target_cloth().modifiers["Cloth"].point_cache.frame_end = 20

    text = refused(refusal, built(end_early, tmp_path / "cloth.blend"))
    assert f"has the frames 1 to {FRAMES}, and the modifier 'Cloth' of 'flesh' has those from 1 to 20;" in text

    def short_scene() -> None:
        targets.target_geometry_nodes()
        bpy.context.scene.frame_end = 25

    text = refused(refusal, built(short_scene, tmp_path / "nodes.blend"))
    assert "the modifier 'Lag' of 'flesh' has those from 1 to 25;" in text


def test_random_poses_of_a_simulation_have_to_settle(refusal, tmp_path):
    rig = built(targets.target_cloth, tmp_path / "rig.blend")
    assert refused(refusal, rig, "--poses", 5).startswith(
        "The target 'flesh' is a simulation (the modifier 'Cloth' of 'flesh'): what it shows in a random pose depends"
    )
    assert refused(refusal, rig, "--poses", 5, "--settle-frames", 9).startswith(
        f"Settled poses are random ones, and '{ACTION}' is to be recorded too, frame by frame;"
    )


def test_a_simulation_that_does_not_move_is_refused(refusal, tmp_path):
    def hold() -> None:
        targets.target_cloth().modifiers["Armature"].show_viewport = False
        bpy.data.objects["flesh"].modifiers["Cloth"].settings.effector_weights.gravity = 0

    rig = built(hold, tmp_path / "rig.blend")
    assert refused(refusal, rig).startswith("The target 'flesh' does not move while 'elbow' does, by ")


@pytest.mark.parametrize("build", [*SLOW_SIMULATIONS, targets.target_geometry_nodes])
def test_a_settled_pose_depends_on_the_pose_alone(build, tmp_path):
    rig = built(build, tmp_path / "rig.blend")
    recording = recorded(rig, tmp_path / "recording", *SETTLED, "--poses", 6)
    assert recording.info.unsettled == ()
    target = json.loads((tmp_path / "recording" / "recording.json").read_text())["target"]
    assert target == {
        "object": "flesh",
        "follows": "simulation",
        "pre_roll": 0,
        "settle_frames": 80,
        "rest_threshold_mm": 0.1,
    }


def test_a_simulation_is_resumed_with_the_options_that_began_it(tmp_path):
    def with_a_root() -> None:
        targets.target_geometry_nodes()
        rig = bpy.data.objects["elbow"].modifiers["Armature"].object
        bpy.context.view_layer.objects.active = rig
        bpy.ops.object.mode_set(mode="EDIT")
        root = rig.data.edit_bones.new("root")
        root.tail, root.use_deform, rig.data.edit_bones["upper"].parent = (0, 0, 0.1), False, root
        bpy.ops.object.mode_set(mode="OBJECT")

    rig = built(with_a_root, tmp_path / "rig.blend")
    words = ("record", rig, tmp_path / "r", "--object", "elbow", "--learn-from", "flesh", "--action", ACTION)
    assert run(*words) == 0
    assert run(*words, "--resume") == 0


@pytest.mark.slow
def test_settling_resumes_where_it_was_killed(tmp_path):
    rig, killed = built(targets.target_cloth, tmp_path / "rig.blend"), tmp_path / "killed"
    whole = recorded(rig, tmp_path / "whole", *SETTLED, "--poses", 8)
    words = ("record", rig, killed, "--object", "elbow", *SETTLED, "--poses", 8)
    process = subprocess.Popen([sys.executable, "-m", "fdda_addon", *map(str, words)], cwd=ROOT)
    while process.poll() is None and complete_poses(killed) < 2:
        time.sleep(0.002)
    process.kill()
    assert process.wait() == systems.KILLED, "it was quicker than the kill"
    assert run(*words, "--resume") == 0
    for name in ("pose_matrices.npy", "positions.npy", "recording.json"):
        assert (killed / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert len(whole.positions) == 8


def linear_mm(recording: Recording) -> float:
    """Return the mean distance of the first poses from linear skinning."""
    return 1000 * float(np.linalg.norm(residuals(recording)[:10], axis=2).mean())


def complete_poses(recording: Path) -> int:
    """Return the number of complete poses in the index of a recording, 0 without an index."""
    try:
        return json.loads((recording / "recording.json").read_text())["complete"]
    except FileNotFoundError:
        return 0


def test_poses_that_do_not_settle_are_named(tmp_path, capfd):
    rig = built(targets.target_soft_body, tmp_path / "rig.blend")
    hasty = "--learn-from", "flesh", "--settle-frames", 12, "--poses", 5
    recording = recorded(rig, tmp_path / "recording", *hasty)
    assert recording.info.unsettled == (0, 1, 2, 3, 4)
    assert "5 of 5 poses did not come to rest in 12 frames: 0, 1, 2 and 2 more" in capfd.readouterr().out


@pytest.mark.slow
def test_a_settled_model_is_evaluated_against_settled_poses(tmp_path, capfd):
    rig = built(targets.target_soft_body, tmp_path / "rig.blend")
    recording = recorded(rig, tmp_path / "recording", *SETTLED, "--poses", 40)
    assert 0 <= recording.info.repeatability_mm < 0.2 * linear_mm(recording)
    capfd.readouterr()
    assert run("check-recording", recording.path) == 0
    assert capfd.readouterr().out.startswith("The same pose from two directions: ")
    assert recording.info.unsettled == ()
    model, errors = tmp_path / "elbow.onnx", tmp_path / "errors.json"
    train(recording.path, model, "--passes", 60)
    options = ["--object", "elbow", *SETTLED, "--poses", 6, "--json", errors]
    assert run("evaluate", rig, model, *options) == 0
    found = json.loads(errors.read_text())
    assert found["fdda"]["mean"] < found["linear"]["mean"]


def test_the_training_report_has_the_repeatability_of_settled_poses(tmp_path):
    rig = built(targets.target_geometry_nodes, tmp_path / "rig.blend")
    recording = recorded(rig, tmp_path / "recording", *SETTLED, "--poses", 12)
    model, errors = tmp_path / "elbow.onnx", tmp_path / "errors.json"
    train(recording.path, model, "--passes", 2, "--hidden", 8)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["repeatability_mm"] == recording.info.repeatability_mm
    assert "two ways to the same pose" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert run("evaluate", rig, model, "--object", "elbow", *SETTLED, "--poses", 2, "--json", errors) == 0
    assert json.loads(errors.read_text())["fdda"]["mean"] > 0


@pytest.mark.slow
def test_cloth_that_folds_one_way_or_the_other_is_named(tmp_path, capfd):
    rig = built(targets.target_cloth, tmp_path / "rig.blend")
    recording = recorded(rig, tmp_path / "recording", *SETTLED, "--poses", 16)
    assert recording.info.repeatability_mm > 0.2 * linear_mm(recording)
    assert run("check-recording", recording.path) == 0
    out = capfd.readouterr().out
    assert "hysteresis" in out and "mm from itself when the same pose is reached from another direction" in out


def test_repeatability_is_measured_once_and_only_where_it_is_missing(tmp_path):
    rig = built(targets.target_geometry_nodes, tmp_path / "rig.blend")
    words = ("record", rig, tmp_path / "recording", "--object", "elbow", *SETTLED, "--poses", 6)
    assert run(*words) == 0
    index = json.loads((tmp_path / "recording" / "recording.json").read_text())
    # The target lags but has no hysteresis, so a settled pose does not depend on the approach.
    measured = index.pop("repeatability_mm")
    assert 0 < measured < 0.5
    for written, expected in ((index, measured), (index | {"repeatability_mm": 7.0}, 7.0)):
        (tmp_path / "recording" / "recording.json").write_text(json.dumps(written))
        assert run(*words, "--resume") == 0
        assert read_recording(tmp_path / "recording").info.repeatability_mm == pytest.approx(expected, rel=1e-3)
    of_flesh(rig, tmp_path / "frames")
    assert "repeatability_mm" not in json.loads((tmp_path / "frames" / "recording.json").read_text())


def test_other_simulations_keep_their_state(tmp_path):
    def with_flag() -> None:
        targets.target_cloth()
        mesh = bpy.data.meshes.new("flag")
        mesh.from_pydata([(x / 9, 2.0, y / 9) for x in range(10) for y in range(10)], [],
                         [(i * 10 + j, i * 10 + j + 1, i * 10 + j + 11, i * 10 + j + 10)
                          for i in range(9) for j in range(9)])  # fmt: skip
        flag = bpy.data.objects.new("flag", mesh)
        bpy.context.scene.collection.objects.link(flag)
        flag.modifiers.new("Cloth", "CLOTH")

    rig = built(with_flag, tmp_path / "rig.blend")
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    for frame in range(1, 13):
        bpy.context.scene.frame_set(frame)
    before = evaluated_positions(bpy.data.objects["flag"])
    settings = RecordingSettings(poses=4, target=TargetSettings("flesh", settle_frames=40))
    drain(record(find_rig("elbow"), tmp_path / "recording", settings))
    assert bpy.context.scene.frame_current == 12
    assert np.array_equal(evaluated_positions(bpy.data.objects["flag"]), before)
    assert np.abs(before - np.array([v.co for v in bpy.data.objects["flag"].data.vertices])).max() > 0.01
