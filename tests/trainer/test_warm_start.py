# SPDX-License-Identifier: GPL-3.0-or-later
"""A training continues from the checkpoint, on a recording that has grown."""

import json
import os
import shutil
import zipfile

import numpy as np
import pytest

from fdda_addon.core.formats.report import checkpoint_path
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingExtension
from trainer.__main__ import main
from trainer.config import TrainingConfig
from trainer.data.split import split_recording
from trainer.inputs.network_inputs import make_inputs
from trainer.networks.checkpoint import read_checkpoint
from trainer.networks.warm_start import initial_networks
from trainer.preparation import partition_data, prepare_partition

from .. import systems
from ..recordings import read_skinned
from .chain import chain_angles, chain_residuals, pose_chain, write_chain
from .conftest import QUICK_OPTIONS

ADDED_POSES = 60


@pytest.fixture
def grown_recording(recording, tmp_path):
    """The recording with refined poses that reach the end of the range."""
    folder = tmp_path / "grown"
    shutil.copytree(recording, folder)
    source = read_recording(folder)
    angles = chain_angles(ADDED_POSES, 3, seed=5)
    angles[:, 2, 1] = 0
    with RecordingExtension(source, ADDED_POSES, "model.onnx") as extension:
        matrices = pose_chain(source.rig, angles)
        skinning = LinearSkinning(source.rig)
        extension.append(matrices, skinning.complex_positions(matrices, chain_residuals(source.rig, angles)))
    return folder


@pytest.fixture
def model(trained, tmp_path):
    """A copy of the model with its checkpoint, from which a test continues the training."""
    for path in (trained / "model.onnx", checkpoint_path(trained / "model.onnx")):
        shutil.copy(path, tmp_path)
    return tmp_path / "model.onnx"


def prepare_recording(path, config, checkpoint):
    recording = read_skinned(path)
    split = split_recording(recording, config)
    inputs = make_inputs(recording.rig, recording.partitions, checkpoint.input_states)
    data = partition_data(recording, inputs)
    prepared = [prepare_partition(partition, split, config.detail_mm, config.seed) for partition in data]
    return split, prepared


def test_networks_start_with_nearly_their_former_outputs(recording, trained, grown_recording):
    config = TrainingConfig(detail_mm=1e-4)
    checkpoint = read_checkpoint(checkpoint_path(trained / "model.onnx"))
    _, prepared = prepare_recording(grown_recording, config, checkpoint)
    networks = initial_networks(checkpoint, prepared)
    compared_count = 0
    for former, current, network in zip(checkpoint.partitions, prepared, networks, strict=True):
        if network is None:
            continue
        features = current.inputs * current.feature_scale + current.feature_mean
        assert np.array_equal(former.columns, current.columns)
        old_coefficients = former.network.evaluate(
            ((features - former.feature_mean) / former.feature_scale).astype(np.float32)
        )
        expected = old_coefficients @ former.basis_components + former.basis_mean
        residuals = current.basis.reconstruct(network.evaluate(current.inputs))
        # The outputs differ a little, because the linear fit and the components are computed from other poses.
        assert np.linalg.norm(residuals - expected) < 0.05 * np.linalg.norm(expected)
        compared_count += 1
    assert compared_count >= 2


def test_a_warm_start_continues_the_training(grown_recording, model, trained):
    first_error = json.loads((trained / "report.json").read_text())["fdda"]["held_out"]["mean"]
    assert main([str(grown_recording), str(model), *QUICK_OPTIONS, "--passes", "12", "--warm-start"]) == 0
    report = json.loads((model.parent / "report.json").read_text())
    # After six epochs from random weights, the error is several times as large.
    assert report["fdda"]["held_out"]["mean"] < 1.5 * first_error
    assert main([str(grown_recording), str(model), *QUICK_OPTIONS, "--passes", "6"]) == 0
    cold_start_report = json.loads((model.parent / "report.json").read_text())
    assert cold_start_report["fdda"]["held_out"]["mean"] > 2 * report["fdda"]["held_out"]["mean"]
    assert main([str(grown_recording), str(model), *QUICK_OPTIONS, "--passes", "12", "--warm-start"]) == 0
    assert report["training"]["warm_start"] and report["poses"] == 120 + ADDED_POSES
    history = read_checkpoint(checkpoint_path(model)).history
    assert [entry["poses"] for entry in history] == [120 + ADDED_POSES] * 2


def test_refined_poses_become_training_poses_and_held_out_poses_stay(recording, grown_recording):
    config = TrainingConfig()
    before, after = (
        split_recording(read_skinned(recording), config),
        split_recording(read_skinned(grown_recording), config),
    )
    assert np.array_equal(before.held_out, after.held_out) and np.array_equal(before.validation, after.validation)
    assert np.array_equal(after.training, [*before.training, *range(120, 120 + ADDED_POSES)])
    parts = (before.training, before.validation, before.held_out)
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(120)) and [len(p) for p in parts] == [102, 6, 12]


def refused_warm_start(capsys, *arguments) -> str:
    options = arguments[2:] or QUICK_OPTIONS
    assert main([*map(str, arguments[:2]), *options, "--warm-start"]) == 1
    return capsys.readouterr().err


def test_a_missing_checkpoint_is_refused(recording, tmp_path, capsys):
    assert "There is no checkpoint" in refused_warm_start(capsys, recording, tmp_path / "m.onnx")


def test_a_checkpoint_of_other_network_or_rig_is_refused(recording, model, tmp_path, capsys):
    assert "is of networks --hidden 24 24 --activation silu" in refused_warm_start(
        capsys, recording, model, "--hidden", "8"
    )
    write_chain(tmp_path / "other", joint_count=4)
    assert "is of another rig" in refused_warm_start(capsys, tmp_path / "other", model)


@pytest.mark.parametrize("options", [["--seed", "1"], ["--held-out-fraction", "0.2"], ["--validation-fraction", "0.2"]])
def test_a_split_that_would_hold_out_training_poses_is_refused(recording, model, capsys, options):
    assert "may have been trained on poses that are held out now" in refused_warm_start(
        capsys, recording, model, *QUICK_OPTIONS, *options
    )


def test_another_recording_of_the_rig_is_refused(model, tmp_path, capsys):
    write_chain(tmp_path / "other", seed=3)
    assert "is of another recording or seed" in refused_warm_start(capsys, tmp_path / "other", model)


@pytest.mark.parametrize(
    "damage_kind",
    ["cut", "text", "packed", "version", "sizes", "nan", "types", pytest.param("pipe", marks=systems.named_pipes)],
)
def test_a_damaged_checkpoint_is_refused(recording, model, capsys, damage_kind):
    path = checkpoint_path(model)
    if damage_kind == "cut":
        path.write_bytes(path.read_bytes()[:1000])
    elif damage_kind == "text":
        path.write_text("weights")
    elif damage_kind == "packed":
        with np.load(path) as arrays:
            content = dict(arrays)
        content["1/basis_mean"] = np.zeros(1 << 22, np.float32)
        np.savez_compressed(path, **content)
        assert zipfile.is_zipfile(path)
    elif damage_kind == "version":
        with np.load(path) as arrays:
            content = dict(arrays)
        about = json.loads(content["about"].tobytes()) | {"version": 1}
        content["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
        np.savez(path, **content)
    elif damage_kind == "pipe":
        path.unlink()
        os.mkfifo(path)
    else:
        with np.load(path) as arrays:
            content = dict(arrays)
        changed_arrays = {
            "sizes": content["1/weight_1"][1:],
            "nan": content["1/weight_1"] * np.nan,
            "types": np.array("x"),
        }
        content["1/weight_1"] = changed_arrays[damage_kind]
        np.savez(path, **content)
    model_before = model.read_bytes()
    text = refused_warm_start(capsys, recording, model)
    if damage_kind == "pipe":
        assert "it is not a regular file" in text
    elif damage_kind == "text":
        assert "another file is there, which is not the checkpoint of a training" in text
    elif damage_kind == "version":
        assert "cannot be used (version 1); train without --warm-start" in text
    else:
        assert "cannot be used" in text and "train without --warm-start" in text
    assert model.read_bytes() == model_before
