# SPDX-License-Identifier: GPL-3.0-or-later
"""The study of network sizes, on the chain: what it writes, that it resumes, and what it refuses."""

import json

import numpy as np
import onnx
import pytest

from benchmarks.study import Plan, main, study
from benchmarks.study_tables import format_tables
from benchmarks.study_trainings import StudyData, Trainings, read_study_data, select_partitions, train_once
from fdda_addon.core.errors import RecordingError
from fdda_addon.core.metrics import error_statistics
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.skinning import LinearSkinning
from fdda_addon.runtime.network import Network
from trainer.config import TrainingConfig
from trainer.inputs import inputs_of_rig, partition_centers
from trainer.splitting import split_poses
from trainer.surface_frame_fit import select_surface_frames

from .chain import write_chain
from .tube import write_tube

NAMES = ("bone_1", "bone_2")
PLAN = Plan(
    units=(8, 24),
    layers=(2,),
    activations=("silu", "relu"),
    extra_configurations=(),
    learning_rates=(0.001, 0.02),
    seeds=(0, 1),
    epochs=10,
)
TRAININGS = 4 * (2 + 1)
"""Four configurations: two learning rates with the first seed, the better one with the second."""


@pytest.fixture(scope="module")
def held_out(tmp_path_factory):
    path = tmp_path_factory.mktemp("recordings") / "held_out"
    write_chain(path, poses=40, seed=7)
    return path


@pytest.fixture(scope="module")
def studied(recording, held_out, tmp_path_factory):
    """Folder of a finished study; a test that changes a file must restore it."""
    out = tmp_path_factory.mktemp("study")
    study(recording, held_out, out, PLAN, NAMES)
    return out


@pytest.fixture
def result(studied):
    return json.loads((studied / "study.json").read_text(encoding="utf-8"))


def test_every_configuration_is_trained_with_every_seed(result):
    found = [(c["units"], c["layers"], c["activation"]) for c in result["configurations"]]
    assert found == [(8, 2, "silu"), (8, 2, "relu"), (24, 2, "silu"), (24, 2, "relu")]
    for configuration in result["configurations"]:
        assert len(configuration["trainings"]) == len(configuration["inference_us"]) == 2
        for training in configuration["trainings"]:
            assert list(training["partitions"]) == list(NAMES)
            for partition in training["partitions"].values():
                assert len(partition["curve"]["validation"]) == PLAN.epochs
                left, errors, linear = (partition[key] for key in ("basis_left", "held_out", "held_out_linear"))
                assert left["held_out"] < errors["mean"] < linear["mean"]
                assert left["validation"] < min(partition["curve"]["validation"])
    assert result["poses"] == {"training": 120, "held_out": 40}


def test_networks_see_surface_frames_where_the_rig_smooths(tmp_path):
    tube = write_tube(tmp_path / "tube")
    names = ("bone_1",)
    small = select_partitions(tube, names)
    inputs = inputs_of_rig(tube.rig, partition_centers(tube.rig, tube.partitions), small.partitions)
    model = tmp_path / "tube.onnx"
    train_once(StudyData(tube, small, small, inputs), TrainingConfig(epochs=1, hidden=(8, 8)), model)
    seen = next(info for info in onnx.load(model).graph.initializer if info.name == "main_joint_axes").dims
    split = split_poses(np.arange(len(tube.pose_matrices)), 0.05, 0)
    of_all = select_surface_frames(tube, split, TrainingConfig().tolerance_mm)
    assert seen[0] == (of_all.main_joints == 1).sum() < len(of_all)


def test_the_learning_rate_is_the_one_of_the_least_validation_error(studied, result):
    for c in result["configurations"]:
        errors = {}
        for rate in PLAN.learning_rates:
            name = f"{c['units']}x{c['layers']}-{c['activation']}-{rate:g}-seed0.json"
            partitions = json.loads((studied / "trainings" / name).read_text())["partitions"].values()
            errors[rate] = sum(p["validation"]["mean"] / p["validation_linear"]["mean"] for p in partitions)
        assert c["learning_rate"] == min(errors, key=errors.get)


def test_the_errors_are_those_of_the_model_on_the_held_out_poses(studied, result, held_out):
    small = select_partitions(read_recording(held_out), NAMES)
    truth = LinearSkinning(small.rig).complex_positions(small.pose_matrices, small.residuals)
    training = result["configurations"][0]["trainings"][1]
    played = Network(studied / "trainings" / training["model"]).positions(small.pose_matrices)
    for partition, name in zip(small.partitions, NAMES, strict=True):
        errors = np.linalg.norm(played - truth, axis=2)[:, partition.vertices]
        assert training["partitions"][name]["held_out"]["mean"] == pytest.approx(
            error_statistics(errors).mean, rel=1e-3
        )


def test_the_networks_see_what_they_see_when_all_partitions_train(recording, held_out):
    whole = read_recording(recording)
    inputs = inputs_of_rig(whole.rig, partition_centers(whole.rig, whole.partitions), whole.partitions)
    features = inputs.compute_features(whole.pose_matrices, whole.rig.rest_matrices)
    study_data = read_study_data(recording, held_out, NAMES)
    own = study_data.inputs.compute_features(study_data.training.pose_matrices, study_data.training.rig.rest_matrices)
    for columns, all_columns in zip(study_data.inputs.columns, inputs.columns[1:], strict=True):
        assert np.array_equal(own[:, columns], features[:, all_columns])


def test_tables_and_pictures(studied, result):
    text = (studied / "tables.md").read_text(encoding="utf-8")
    assert text == format_tables(result)
    for configuration in result["configurations"]:
        hidden = f"{configuration['units']} {configuration['units']}"
        assert f"| {hidden} | {configuration['activation']} | {configuration['learning_rate']:g} |" in text
    assert "24 units in place of 8" in text and "relu in place of silu" in text
    for picture in ("study_curves.png", "study_errors.png"):
        assert (studied / picture).read_bytes().startswith(b"\x89PNG")


def test_a_factor_is_the_ratio_of_what_differs_in_it_alone(result):
    for configuration in result["configurations"]:
        for seed, training in enumerate(configuration["trainings"]):
            for partition in training["partitions"].values():
                partition["held_out"]["mean"] = (2.0 if configuration["units"] == 24 else 4.0) * (1 + seed)
    (row,) = [line for line in format_tables(result).splitlines() if line.startswith("| 24 units")]
    assert row.split(" | ")[1] == "0.50 (0.50 to 0.50), less in 4 of 4"


def test_an_interrupted_study_resumes(studied, recording, held_out, capsys):
    before = sorted((studied / "trainings").iterdir())
    assert len(before) == 2 * TRAININGS
    gone = studied / "trainings" / "8x2-relu-0.001-seed0.json"
    errors = json.loads(gone.read_text())["partitions"]
    gone.unlink()
    study(recording, held_out, studied, PLAN, NAMES)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("8x2-relu-0.001-seed0: ")
    assert json.loads(gone.read_text())["partitions"] == errors
    assert sorted((studied / "trainings").iterdir()) == before


def test_other_settings_train_again(recording, held_out, tmp_path, capsys):
    study_data = read_study_data(recording, held_out, NAMES)
    for epochs in (2, 3):
        trainings = Trainings(study_data, tmp_path, print)
        training = trainings.get(TrainingConfig(hidden=(8, 8), epochs=epochs))
        assert trainings.trained_count == 1
        assert len(training["partitions"]["bone_1"]["curve"]["validation"]) == epochs


def test_a_missing_partition_is_refused(recording, held_out, tmp_path):
    with pytest.raises(RecordingError, match="has no partition 'shoulder'; it has bone_0, bone_1, bone_2"):
        study(recording, held_out, tmp_path, PLAN, ("shoulder",))


def test_training_poses_as_held_out_poses_are_refused(recording, tmp_path):
    with pytest.raises(RecordingError, match=r"has seed 0, as .* its poses are no held-out ones"):
        study(recording, recording, tmp_path, PLAN, NAMES)


def test_recordings_of_two_rigs_are_refused(recording, tmp_path):
    write_chain(tmp_path / "other", poses=20, joints=4, seed=3)
    with pytest.raises(RecordingError, match="is of another rig than"):
        study(recording, tmp_path / "other", tmp_path, PLAN, NAMES)


def test_an_output_that_is_a_file_is_refused(tmp_path, capsys):
    (tmp_path / "out").write_text("text")
    assert main([str(tmp_path / "out")]) == 1
    assert capsys.readouterr().err == (
        f"Cannot write into '{tmp_path / 'out'}': '{tmp_path / 'out'}' is a file; choose another folder.\n"
    )


def test_zero_seeds_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        main([str(tmp_path), "--seeds", "0"])
    assert exit_.value.code == 2 and "--seeds and --poses must be 1 or more" in capsys.readouterr().err
