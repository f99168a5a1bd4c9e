# SPDX-License-Identifier: GPL-3.0-or-later
"""The study of network sizes trains all configurations, writes tables and pictures, resumes, and refuses bad input."""

import json

import numpy as np
import onnx
import pytest

from benchmarks.study import Plan, main, study
from benchmarks.study_tables import format_tables
from benchmarks.study_trainings import (
    StudyData,
    Trainings,
    make_study_inputs,
    read_study_data,
    select_partitions,
    train_once,
)
from fdda_addon.core.errors import RecordingError
from fdda_addon.core.metrics import error_statistics
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.skinning import LinearSkinning
from fdda_addon.runtime.network import Network
from trainer.config import TrainingConfig
from trainer.data.split import split_poses
from trainer.inputs.network_inputs import make_inputs
from trainer.inputs.surface_frame_fit import select_surface_frames

from .chain import write_chain
from .tube import write_tube

PARTITION_NAMES = ("bone_1", "bone_2")
PLAN = Plan(
    units=(8, 24),
    layers=(2,),
    activations=("silu", "relu"),
    extra_configurations=(),
    learning_rates=(0.001, 0.02),
    seeds=(0, 1),
    epochs=10,
)
TRAINING_COUNT = 4 * (2 + 1)
"""Number of trainings. Each of four configurations is trained with two learning rates and the first seed, and then with
the better rate and the second seed."""


@pytest.fixture(scope="module")
def held_out(tmp_path_factory):
    path = tmp_path_factory.mktemp("recordings") / "held_out"
    write_chain(path, pose_count=40, seed=7)
    return path


@pytest.fixture(scope="module")
def study_folder(recording, held_out, tmp_path_factory):
    """Folder of a finished study; a test that changes a file must restore it."""
    out = tmp_path_factory.mktemp("study")
    study(recording, held_out, out, PLAN, PARTITION_NAMES)
    return out


@pytest.fixture
def result(study_folder):
    return json.loads((study_folder / "study.json").read_text(encoding="utf-8"))


def test_every_configuration_is_trained_with_every_seed(result):
    sizes_and_activations = [(c["units"], c["layers"], c["activation"]) for c in result["configurations"]]
    assert sizes_and_activations == [(8, 2, "silu"), (8, 2, "relu"), (24, 2, "silu"), (24, 2, "relu")]
    for configuration in result["configurations"]:
        assert len(configuration["trainings"]) == len(configuration["inference_us"]) == 2
        for training in configuration["trainings"]:
            assert list(training["partitions"]) == list(PARTITION_NAMES)
            for partition in training["partitions"].values():
                assert len(partition["curve"]["validation"]) == PLAN.epochs
                truncation_errors, errors, linear = (
                    partition[key] for key in ("basis_left", "held_out", "held_out_linear")
                )
                assert truncation_errors["held_out"] < errors["mean"] < linear["mean"]
                assert truncation_errors["validation"] < min(partition["curve"]["validation"])
    assert result["poses"] == {"training": 120, "held_out": 40}


def test_networks_of_a_rig_that_smooths_take_surface_frames(tmp_path):
    tube_recording = write_tube(tmp_path / "tube")
    names = ("bone_1",)
    cut_recording = select_partitions(tube_recording, names)
    model = tmp_path / "tube.onnx"
    train_once(StudyData(tube_recording, cut_recording, cut_recording), TrainingConfig(epochs=1, hidden=(8, 8)), model)
    network_frames_shape = next(
        info for info in onnx.load(model).graph.initializer if info.name == "main_joint_axes"
    ).dims
    split = split_poses(np.arange(len(tube_recording.pose_matrices)), 0.05, 0)
    all_surface_frames = select_surface_frames(tube_recording, split, TrainingConfig().tolerance_mm)
    assert network_frames_shape[0] == (all_surface_frames.main_joints == 1).sum() < len(all_surface_frames)


def test_the_learning_rate_with_the_lowest_validation_error_is_chosen(study_folder, result):
    for c in result["configurations"]:
        errors = {}
        for rate in PLAN.learning_rates:
            name = f"{c['units']}x{c['layers']}-{c['activation']}-{rate:g}-seed0.json"
            partitions = json.loads((study_folder / "trainings" / name).read_text())["partitions"].values()
            errors[rate] = sum(p["validation"]["mean"] / p["validation_linear"]["mean"] for p in partitions)
        assert c["learning_rate"] == min(errors, key=errors.get)


def test_the_study_reports_the_errors_of_the_models_on_held_out_poses(study_folder, result, held_out):
    cut_recording = select_partitions(read_recording(held_out), PARTITION_NAMES)
    truth = LinearSkinning(cut_recording.rig).complex_positions(cut_recording.pose_matrices, cut_recording.residuals)
    training = result["configurations"][0]["trainings"][1]
    positions = Network(study_folder / "trainings" / training["model"]).positions(cut_recording.pose_matrices)
    for partition, name in zip(cut_recording.partitions, PARTITION_NAMES, strict=True):
        errors = np.linalg.norm(positions - truth, axis=2)[:, partition.vertices]
        assert training["partitions"][name]["held_out"]["mean"] == pytest.approx(
            error_statistics(errors).mean, rel=1e-3
        )


def test_a_studied_partition_has_the_inputs_of_a_whole_training(recording, held_out):
    whole_recording = read_recording(recording)
    inputs = make_inputs(whole_recording.rig, whole_recording.partitions)
    all_features = inputs.compute_features(whole_recording.pose_matrices, whole_recording.controls)
    study_data = read_study_data(recording, held_out, PARTITION_NAMES)
    study_inputs = make_study_inputs(study_data, {})
    features = study_inputs.compute_features(study_data.training.pose_matrices, study_data.training.controls)
    for columns, all_columns in zip(study_inputs.columns, inputs.columns[1:], strict=True):
        assert np.array_equal(features[:, columns], all_features[:, all_columns])


def test_the_study_writes_tables_and_pictures(study_folder, result):
    text = (study_folder / "tables.md").read_text(encoding="utf-8")
    assert text == format_tables(result)
    for configuration in result["configurations"]:
        hidden = f"{configuration['units']} {configuration['units']}"
        assert f"| {hidden} | {configuration['activation']} | {configuration['learning_rate']:g} |" in text
    assert "24 units instead of 8" in text and "relu instead of silu" in text
    for picture in ("study_curves.png", "study_errors.png"):
        assert (study_folder / picture).read_bytes().startswith(b"\x89PNG")


def test_a_factor_compares_configurations_that_differ_in_one_setting(result):
    for configuration in result["configurations"]:
        for seed, training in enumerate(configuration["trainings"]):
            for partition in training["partitions"].values():
                partition["held_out"]["mean"] = (2.0 if configuration["units"] == 24 else 4.0) * (1 + seed)
    (row,) = [line for line in format_tables(result).splitlines() if line.startswith("| 24 units")]
    assert row.split(" | ")[1] == "0.50 (0.50 to 0.50), less in 4 of 4"


def test_an_interrupted_study_resumes(study_folder, recording, held_out, capsys):
    files_before = sorted((study_folder / "trainings").iterdir())
    assert len(files_before) == 2 * TRAINING_COUNT
    removed_file = study_folder / "trainings" / "8x2-relu-0.001-seed0.json"
    errors = json.loads(removed_file.read_text())["partitions"]
    removed_file.unlink()
    study(recording, held_out, study_folder, PLAN, PARTITION_NAMES)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("8x2-relu-0.001-seed0: ")
    assert json.loads(removed_file.read_text())["partitions"] == errors
    assert sorted((study_folder / "trainings").iterdir()) == files_before


def test_other_settings_are_trained_again(recording, held_out, tmp_path, capsys):
    study_data = read_study_data(recording, held_out, PARTITION_NAMES)
    for epochs in (2, 3):
        trainings = Trainings(study_data, tmp_path, print)
        training = trainings.get(TrainingConfig(hidden=(8, 8), epochs=epochs))
        assert trainings.trained_count == 1
        assert len(training["partitions"]["bone_1"]["curve"]["validation"]) == epochs


def test_a_missing_partition_is_refused(recording, held_out, tmp_path):
    with pytest.raises(RecordingError, match="has no partition 'shoulder'; it has bone_0, bone_1, bone_2"):
        study(recording, held_out, tmp_path, PLAN, ("shoulder",))


def test_training_poses_as_held_out_poses_are_refused(recording, tmp_path):
    with pytest.raises(RecordingError, match=r"has seed 0, like .* its poses are not held-out poses"):
        study(recording, recording, tmp_path, PLAN, PARTITION_NAMES)


def test_recordings_of_two_rigs_are_refused(recording, tmp_path):
    write_chain(tmp_path / "other", pose_count=20, joint_count=4, seed=3)
    with pytest.raises(RecordingError, match="is a recording of a different rig than"):
        study(recording, tmp_path / "other", tmp_path, PLAN, PARTITION_NAMES)


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
