# SPDX-License-Identifier: GPL-3.0-or-later
"""After the training, components that the networks do not predict are dropped, and large partitions are factorized."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from fdda_addon.core.formats.report import checkpoint_path
from fdda_addon.core.mathematics.metrics import distances
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.runtime.network import Network as ModelNetwork
from trainer import compression
from trainer.__main__ import main
from trainer.compression import _change_basis, drop_components, dropped_components_sentence, factorize_partition
from trainer.config import TrainingConfig
from trainer.data.split import Split, split_poses, split_recording
from trainer.inputs.network_inputs import make_inputs
from trainer.networks.checkpoint import read_checkpoint
from trainer.networks.loop import train
from trainer.networks.networks import Curves, Network, TrainedPartition
from trainer.preparation import PartitionData, partition_data, prepare_partition, prepare_partitions

from ..recordings import read_skinned, write_recording
from .chain import chain_angles, chain_info, chain_residuals, chain_rig, pose_chain
from .conftest import QUICK_OPTIONS
from .test_low_rank import INFLUENCING, JOINTS, POSES, VERTICES, sliding_residuals

CONFIG = TrainingConfig(passes=60, hidden=(16, 16), batch_size=16)
VERTEX_COUNT = 40


def make_data(noise: float, signal: float = 0.01) -> PartitionData:
    """Create residuals of two fixed patterns: one follows the only feature, the other is random in each pose."""
    rng = np.random.default_rng(0)
    features = rng.uniform(-1, 1, (200, 1)).astype(np.float32)
    patterns = rng.normal(size=(2, VERTEX_COUNT, 3))
    amplitudes = np.stack([signal * np.sin(2 * features[:, 0]), noise * rng.normal(size=200)], axis=1)
    residuals = np.einsum("np,pvc->nvc", amplitudes, patterns).astype(np.float32)
    return PartitionData(features, lambda: residuals)


def train_partitions(*data: PartitionData) -> tuple[list[TrainedPartition], Split]:
    split = split_poses(np.arange(len(data[0].features)), 0.2, 0, 0.2)
    prepared = [prepare_partition(partition, split, 0.01, 0) for partition in data]
    return train(prepared, split, CONFIG, torch.device("cpu")), split


def mean_error(data: PartitionData, partition: TrainedPartition, poses: np.ndarray) -> float:
    predicted = partition.basis.reconstruct(partition.network.evaluate(partition.inputs[poses]))
    return float(np.linalg.norm(data.read_residuals()[poses] - predicted.reshape(-1, VERTEX_COUNT, 3), axis=2).mean())


def test_random_components_are_dropped_and_predictable_ones_stay():
    data = make_data(noise=0.003)
    prepared, split = train_partitions(data)
    (partition,) = drop_components(prepared, split)
    assert len(prepared[0].basis.components) == 2 and len(partition.basis.components) == 1
    assert partition.dropped_count == 1 and partition.coefficients.shape == (200, 1)
    assert partition.network.weights[-1].shape == (16, 1) and partition.network.biases[-1].shape == (1,)
    errors = [mean_error(data, p, split.held_out) for p in (prepared[0], partition)]
    assert errors[1] < 1.05 * errors[0]
    residuals = data.read_residuals().reshape(200, -1)
    truncated = residuals - partition.basis.reconstruct(partition.coefficients)
    rms = np.sqrt((truncated[split.training] ** 2).sum(axis=1).mean() / VERTEX_COUNT)
    assert partition.basis.truncation_rms == pytest.approx(rms, rel=0.01)
    # What remains is the noise.
    assert partition.validation_truncation.mean() > 3 * prepared[0].validation_truncation.mean()


def test_nothing_is_dropped_where_all_is_predictable():
    prepared, split = train_partitions(make_data(noise=0))
    (partition,) = drop_components(prepared, split)
    for poses in (split.training, split.held_out):
        before, after = (p.basis.reconstruct(p.network.evaluate(p.inputs[poses])) for p in (prepared[0], partition))
        np.testing.assert_allclose(after, before, atol=1e-6)
    assert not partition.dropped_count and dropped_components_sentence(prepared, [partition]) == ""


def test_a_partition_of_noise_loses_its_network():
    prepared, split = train_partitions(make_data(noise=0.01, signal=0), make_data(noise=0))
    remaining = drop_components(prepared, split)
    assert [len(partition.basis.components) for partition in remaining] == [0, 1]
    assert [weight.shape for weight in remaining[0].network.weights] == [(1, 0)]
    assert remaining[0].network.evaluate(remaining[0].inputs).shape == (200, 0)
    sentence = dropped_components_sentence(prepared, remaining)
    assert sentence.startswith("The networks do not predict 1 of 2 components") and "record more poses" in sentence


def test_components_without_truncation_error_have_a_finite_error():
    """Rounding makes the squared error that remains without dropped components negative."""
    prepared, split = train_partitions(make_data(noise=0.003))
    basis = replace(prepared[0].basis, error_by_count=prepared[0].basis.error_by_count * [1, 1, 0])
    exact = replace(prepared[0], basis=basis)
    for angle in np.linspace(0, 3, 50):
        change = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        changed = _change_basis(exact, change, split)
        assert np.isfinite(changed.basis.error_by_count).all()


@pytest.mark.parametrize("kind", ["overshoot", "refined"])
def test_a_component_for_extreme_poses_stays(kind):
    rng = np.random.default_rng(0)
    inside, beyond = rng.uniform(-1, 1, 200), rng.uniform(1, 2, 100) * rng.choice([-1, 1], 100)
    features = np.append(inside, beyond)[:, None].astype(np.float32)
    bursts = np.sign(features) * np.maximum(np.abs(features) - 1, 0)
    amplitudes = np.concatenate([0.01 * np.cos(2 * features), 0.1 * bursts], axis=1)
    patterns = rng.normal(size=(2, VERTEX_COUNT, 3))
    residuals = np.einsum("np,pvc->nvc", amplitudes, patterns).astype(np.float32)
    data = PartitionData(features, lambda: residuals)
    inner, extremes = split_poses(np.arange(200), 0.2, 0, 0.2), np.arange(200, 300)
    split = Split(np.append(inner.training, extremes), inner.validation, inner.held_out, **{kind: extremes})
    prepared = [prepare_partition(data, split, 0.01, 0)]
    prepared = train(prepared, split, CONFIG, torch.device("cpu"))
    (partition,) = drop_components(prepared, split)
    error = mean_error(data, partition, extremes)
    assert error < 1.1 * mean_error(data, prepared[0], extremes) < 0.2 * np.abs(residuals[extremes]).mean()


@pytest.fixture(scope="module")
def noisy_chain(tmp_path_factory):
    """Folder with a recording of the chain whose vertices also move at random, and a model trained on it."""
    folder, rig, poses = tmp_path_factory.mktemp("noisy"), chain_rig(3), 120
    angles, rng = chain_angles(poses, 3, 0), np.random.default_rng(1)
    pattern = np.sin(7 * rig.rest_positions.astype(np.float64))
    residuals = chain_residuals(rig, angles) + 0.01 * rng.normal(size=(poses, 1, 1)) * pattern
    partitions = make_partitions(rig, {0: (1,), 1: (1, 2), 2: (2,)})
    write_recording(
        folder / "recording", rig, partitions, chain_info(poses), pose_chain(rig, angles), residuals.astype(np.float32)
    )
    return folder


def test_the_log_and_the_report_name_the_dropped_components(noisy_chain, capsys):
    model = noisy_chain / "model.onnx"
    assert main([str(noisy_chain / "recording"), str(model), *QUICK_OPTIONS]) == 0
    partitions = json.loads((noisy_chain / "report.json").read_text(encoding="utf-8"))["partitions"]
    dropped, kept = (sum(partition[key] for partition in partitions) for key in ("dropped", "basis"))
    assert dropped > 0
    output = capsys.readouterr()
    assert f"The networks do not predict {dropped} of {dropped + kept} components" in output.out + output.err
    page = " ".join((noisy_chain / "report.html").read_text(encoding="utf-8").split())
    assert f"{dropped} more components were left out, because the networks do not predict them." in page
    # The checkpoint has the remaining components, and a training continues from it.
    checkpoint = read_checkpoint(checkpoint_path(model))
    assert [len(partition.basis_components) for partition in checkpoint.partitions] == [p["basis"] for p in partitions]
    assert main([str(noisy_chain / "recording"), str(model), *QUICK_OPTIONS, "--warm-start"]) == 0


def test_a_model_without_components_plays_and_its_training_continues(recording, trained, tmp_path, monkeypatch):
    monkeypatch.setattr(compression, "MIN_GAIN_RATIO", np.inf)
    model = tmp_path / "model.onnx"
    assert main([str(recording), str(model), *QUICK_OPTIONS]) == 0
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert all(partition["basis"] == 0 for partition in report["partitions"])
    assert any(partition["dropped"] > 0 for partition in report["partitions"])
    # The linear fit remains.
    assert report["fdda"]["held_out"]["mean"] < 0.9 * report["linear"]["held_out"]["mean"]
    rig = read_skinned(recording).rig
    poses = pose_chain(rig, chain_angles(20, len(rig.joints), 5))
    complete, linear = ModelNetwork(trained / "model.onnx").positions(poses), LinearSkinning(rig).positions(poses)
    assert distances(ModelNetwork(model).positions(poses), complete).mean() < distances(linear, complete).mean()
    monkeypatch.undo()
    assert main([str(recording), str(model), *QUICK_OPTIONS, "--warm-start"]) == 0
    continued = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert continued["fdda"]["held_out"]["mean"] < 0.5 * report["fdda"]["held_out"]["mean"]


def test_factorized_networks_predict_the_projected_residuals(tmp_path):
    rig, angles = chain_rig(JOINTS, VERTICES), chain_angles(POSES, JOINTS, 0)
    write_recording(
        tmp_path / "tube",
        rig,
        make_partitions(rig, INFLUENCING),
        chain_info(POSES),
        pose_chain(rig, angles),
        sliding_residuals(rig, angles),
    )
    recording = read_skinned(tmp_path / "tube")
    split = split_recording(recording, CONFIG)
    data = partition_data(recording, make_inputs(recording.rig, recording.partitions))
    prepared, rng = prepare_partitions(data, split, [0], TrainingConfig()), np.random.default_rng(0)
    for index, partition in enumerate(prepared):
        sizes = (len(partition.columns), 8, len(partition.basis.components))
        weights = [rng.normal(size=shape).astype(np.float32) for shape in pairwise(sizes)]
        biases = [rng.normal(size=size).astype(np.float32) for size in sizes[1:]]
        network = Network(tuple(weights), tuple(biases), "silu")
        prepared[index] = TrainedPartition(**vars(partition), network=network, curves=Curves())
    factorized = [factorize_partition(*partitions, split, 4e-5) for partitions in zip(prepared, data, strict=True)]
    for before, after in zip(prepared, factorized, strict=True):
        assert after.vertex_factors is not None and before.vertex_factors is None
        predicted, expected = (
            (p.network.evaluate(p.inputs).astype(np.float64) @ p.basis.components).reshape(POSES, -1, 3)
            for p in (after, before)
        )
        vertex_factors = after.vertex_factors.astype(np.float64)
        expected = np.einsum("nvc,rv,rw->nwc", expected, vertex_factors, vertex_factors, optimize=True)
        np.testing.assert_allclose(predicted, expected, atol=1e-4 * np.abs(expected).max())
        np.testing.assert_allclose(
            after.coefficients @ after.basis.components @ after.basis.components.T, after.coefficients, atol=1e-5
        )
