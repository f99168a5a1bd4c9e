# SPDX-License-Identifier: GPL-3.0-or-later
"""`record --refine` and `train --goal-mm --refine`: more poses where the model is worst, until it is good enough."""

import shutil

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from fdda_addon.core.errors import FDDAError
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.mathematics.features import joint_features
from fdda_addon.core.mathematics.metrics import distances
from fdda_addon.core.recording.index import REFINED
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.refinement import RefinementSettings, refine
from fdda_addon.recording.run import record
from fdda_addon.rig.reading import PoseEvaluator, read_rig
from fdda_addon.runtime.network import Network
from fdda_addon.scene.scene_rig import find_rig

from .conftest import ELBOW_RIG, run, train
from .scene_state import drain, scene_state

pytestmark = pytest.mark.one_blender_version


@pytest.fixture
def recording(elbow_files, tmp_path):
    """A copy of the elbow's recording, to be extended."""
    return shutil.copytree(elbow_files.recording, tmp_path / "recording")


def errors(recording, model, poses: slice) -> np.ndarray:
    """Return the largest error of the model in each of these recorded poses, shape (poses,)."""
    matrices = np.array(recording.pose_matrices[poses])
    return distances(Network(model).positions(matrices), np.array(recording.positions[poses])).max(axis=1)


def test_poses_are_added_where_the_model_errs(elbow_files, recording):
    before = read_recording(recording)
    assert run("record", elbow_files.rig, recording, "--refine", elbow_files.model, "--poses", 60) == 0
    after = read_recording(recording)
    assert len(after.pose_matrices) == 222
    assert after.info.sampling.sources[-1] == type(after.info.sampling.sources[0])(REFINED, 60, "elbow.onnx")
    assert np.array_equal(after.pose_matrices[:162], before.pose_matrices)
    assert np.array_equal(after.positions[:162], before.positions)
    # The added poses were chosen for their large errors, so their mean error exceeds that of the other poses.
    rest = np.arange(0, 150, 10)
    assert (
        errors(after, elbow_files.model, slice(162, 222)).mean() > 1.2 * errors(after, elbow_files.model, rest).mean()
    )


def test_added_poses_have_the_positions_of_the_rig(elbow_files, recording):
    assert run("record", elbow_files.rig, recording, "--refine", elbow_files.model, "--poses", 8) == 0
    read = read_recording(recording)
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    scene_rig = find_rig()
    evaluator = PoseEvaluator(scene_rig, read_rig(scene_rig))
    features = joint_features(read.pose_matrices[-1:], read.rig.rest_matrices, read.rig.parents)[0]
    for joint, name in enumerate(read.rig.joint_names):
        basis = np.vstack([features[joint].reshape(3, 4), [0, 0, 0, 1]])
        scene_rig.armature_object.pose.bones[name].matrix_basis = Matrix(basis)
    bpy.context.view_layer.update()
    pose, positions, _ = evaluator.evaluate()
    assert np.abs(pose - read.pose_matrices[-1]).max() < 1e-5
    assert np.abs(read.positions[-1] - positions).max() < 1e-5


def test_every_refinement_chooses_other_poses(elbow_files, recording):
    for _ in range(2):
        assert run("record", elbow_files.rig, recording, "--refine", elbow_files.model, "--poses", 5) == 0
    read = read_recording(recording)
    assert [(s.kind, s.poses) for s in read.info.sampling.sources] == [
        *(("random", 150), ("alone", 12)),
        *((REFINED, 5), (REFINED, 5)),
    ]
    assert np.abs(read.pose_matrices[162:167] - read.pose_matrices[167:172]).max() > 1e-3


def test_an_interruption_leaves_a_complete_recording_and_the_scene(elbow_files, recording, rig):
    state = scene_state(rig)
    steps = refine(rig, recording, elbow_files.model, RefinementSettings(poses=5))
    for step in steps:
        if step.done == 3:
            break
    steps.close()
    assert scene_state(rig) == state
    assert len(read_recording(recording).pose_matrices) == 162


def sentence(rig, recording, model) -> str:
    with pytest.raises(FDDAError) as error:
        list(refine(rig, recording, model, RefinementSettings(poses=2)))
    assert str(error.value).endswith(".") and "\n" not in str(error.value)
    return str(error.value)


def test_another_range_of_motion_is_refused(elbow_files, recording, rig, tmp_path):
    """A recording keeps its range of motion, whatever the rig limits or locks since."""
    for bone in bpy.data.objects[ELBOW_RIG].pose.bones:
        bone.lock_rotation[1] = not bone.lock_rotation[1]
    drain(refine(rig, recording, elbow_files.model, RefinementSettings(poses=2)))
    assert len(read_recording(recording).pose_matrices) == 164
    drain(record(rig, tmp_path / "locked", RecordingSettings(poses=4)))
    assert "The range of motion of the model is not that of" in sentence(rig, tmp_path / "locked", elbow_files.model)


def test_an_action_alone_has_no_range_of_motion(elbow_files, tmp_path, rig):
    assert run("record", elbow_files.rig, tmp_path / "a", "--poses", 0, "--action", "elbow_wave") == 0
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.rig))
    assert "has no random poses" in sentence(find_rig(), tmp_path / "a", elbow_files.model)


def test_another_rig_is_refused(elbow_files, recording, rig):
    rig.mesh_object.data.vertices[0].co.x += 0.1
    if rig.mesh_object.data.shape_keys:
        rig.mesh_object.data.shape_keys.reference_key.data[0].co.x += 0.1
    assert "was trained for another rig" in sentence(rig, recording, elbow_files.model)


@pytest.mark.parametrize("option", [["--action", "elbow_wave"], ["--poses", 0]])
def test_contradicting_options_of_record_are_refused(elbow_files, recording, capfd, option):
    assert run("record", elbow_files.rig, recording, "--refine", elbow_files.model, *option) == 2
    assert "--refine adds random poses to a complete recording" in capfd.readouterr().err


def test_training_refines_until_the_goal_is_met(elbow_files, recording, tmp_path, capfd):
    model = tmp_path / "m.onnx"
    quick = ("--passes", 4, "--hidden", 8)
    train(recording, model, *quick)
    goal_mm = 0.9 * read_model_info(model).held_out_mm["p999"]
    assert run("train", recording, model, *quick, "--goal-mm", goal_mm, "--refine", elbow_files.rig, "--poses", 40) == 0
    out = capfd.readouterr()
    read, info = read_recording(recording), read_model_info(model)
    added = [s.poses for s in read.info.sampling.sources if s.kind == REFINED]
    assert added and set(added) == {40}
    assert f"{recording}: added 40 poses at the worst errors of the model" in out.out
    assert ("The goal is met" in out.err) == (info.held_out_mm["p999"] <= goal_mm)
    assert info.training["warm_start"] and info.training["training_poses"] == len(read.pose_matrices) - 12 - 15 - 8


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--refine", "RIG"], "give the goal with --goal-mm"),
        (["--object", "elbow"], "give --refine RIG.blend too"),
    ],
)
def test_options_of_the_goal_that_contradict_are_refused(elbow_files, recording, tmp_path, capfd, options, words):
    options = [elbow_files.rig if option == "RIG" else option for option in options]
    assert run("train", recording, tmp_path / "m.onnx", *options) == 2
    assert words in capfd.readouterr().err
    assert run("train", "--goal-mm", 1, recording, tmp_path / "m.onnx", "--refine", elbow_files.rig) == 2
    assert "give RECORDING and MODEL.onnx before the training settings" in capfd.readouterr().err
    assert run("train", recording, tmp_path / "m.onnx", "--goal-mm", 1, "--refine", tmp_path / "no.blend") == 1
    assert "There is no file" in capfd.readouterr().err
