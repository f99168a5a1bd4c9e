# SPDX-License-Identifier: GPL-3.0-or-later
"""Networks of all partitions are trained together, on the chosen device, with an optimizer like PyTorch's."""

import json
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from trainer.__main__ import main
from trainer.config import TrainingConfig
from trainer.data.split import split_poses
from trainer.device import CPU, GPU, TrainingDevice, choose_device
from trainer.networks.loop import MIN_BETA_1, OneCycleAdamW, _Loop, train
from trainer.networks.networks import ACTIVATION_FUNCTIONS, PartitionNetworks
from trainer.preparation import PartitionData, prepare_partition

from .chain import chain_angles
from .conftest import QUICK_OPTIONS, REPOSITORY

CONFIG = TrainingConfig(passes=30, hidden=(16, 16), batch_size=16, detail_mm=0.01, learning_rate=0.01)


def make_partition_data(inputs: int, vertices: int, seed: int, poses: int = 150) -> PartitionData:
    """Create a partition with residuals of some millimeters that depend smoothly on its features."""
    features = np.sin(chain_angles(poses, inputs + 1, seed)[:, 1:, 0]).astype(np.float32)
    rng = np.random.default_rng(seed)
    values = np.tanh(features @ rng.normal(size=(inputs, 4))) @ rng.normal(size=(4, 3 * vertices)) * 0.002
    residuals = values.reshape(poses, vertices, 3).astype(np.float32)
    return PartitionData(features, lambda: residuals)


def train_partitions(partitions, config=CONFIG, **options):
    split = split_poses(np.arange(len(partitions[0].features)), config.validation_fraction, config.seed)
    prepared = [prepare_partition(p, split, config.detail_mm, config.seed) for p in partitions]
    return prepared, train(prepared, split, config, torch.device("cpu"), **options)


@pytest.mark.parametrize("activation", sorted(ACTIVATION_FUNCTIONS))
def test_padding_does_not_change_outputs(activation):
    generator = torch.Generator().manual_seed(0)
    model = PartitionNetworks([3, 7], [5, 2], (8, 6), activation, generator)
    inputs = torch.randn(2, 4, 7, generator=generator)
    inputs[0, :, 3:] = 0
    outputs = model(inputs)
    values = inputs[0, :, :3]
    for layer in range(3):
        weight = model.weights[layer][0][:3] if layer == 0 else model.weights[layer][0]
        values = values @ weight + model.biases[layer][0]
        if layer < 2:
            values = ACTIVATION_FUNCTIONS[activation](values)
    torch.testing.assert_close(outputs[0], values)
    assert outputs[1, :, 2:].abs().max() == 0


def test_training_learns_every_partition():
    prepared, trained = train_partitions([make_partition_data(2, 12, 0), make_partition_data(5, 7, 1)])
    for data, partition in zip(prepared, trained, strict=True):
        network, curve = partition.network, partition.curves
        assert min(curve.validation_mm) < 0.15 * data.residual_rms * 1000
        assert curve.validation_mm[curve.best_epoch - 1] == min(curve.validation_mm)
        assert [w.shape[0] for w in network.weights] == [data.inputs.shape[1], 16, 16]
        assert network.weights[-1].shape[1] == len(data.basis.components)


def test_the_training_returns_the_weights_of_the_best_epoch():
    """The residuals are noisy, so the networks overfit the training poses, and the last epoch is not the best."""
    smooth_partition = make_partition_data(3, 10, 2, poses=40)
    rng = np.random.default_rng(3)
    noise = rng.normal(scale=0.02, size=smooth_partition.read_residuals().shape).astype(np.float32)
    prepared, trained = train_partitions(
        [replace(smooth_partition, read_residuals=lambda: smooth_partition.read_residuals() + noise)]
    )
    assert trained[0].curves.best_epoch < CONFIG.passes
    split = split_poses(np.arange(40), CONFIG.validation_fraction, CONFIG.seed)
    coefficients = trained[0].network.evaluate(prepared[0].inputs[split.validation])
    squared = ((coefficients - prepared[0].coefficients[split.validation]) ** 2).sum(axis=1) / 10
    error = np.sqrt(squared + prepared[0].validation_truncation ** 2).mean() * 1000
    assert error == pytest.approx(min(trained[0].curves.validation_mm), rel=1e-3)


def test_one_seed_gives_the_same_weights_and_another_does_not():
    partitions = [make_partition_data(3, 10, 2), make_partition_data(2, 5, 3)]
    config = TrainingConfig(passes=3, hidden=(8,), batch_size=16)
    first, second = ([p.network for p in train_partitions(partitions, config)[1]] for _ in range(2))
    for first_network, second_network in zip(first, second, strict=True):
        for first_array, second_array in zip(
            (*first_network.weights, *first_network.biases),
            (*second_network.weights, *second_network.biases),
            strict=True,
        ):
            np.testing.assert_array_equal(first_array, second_array)
    reseeded_config = TrainingConfig(seed=1, passes=3, hidden=(8,), batch_size=16)
    assert not np.array_equal(
        train_partitions(partitions, reseeded_config)[1][0].network.weights[0], first[0].weights[0]
    )


def test_a_partition_without_inputs_keeps_its_mean():
    without_features, constant = (
        PartitionData(features, make_partition_data(2, 6, 4).read_residuals)
        for features in (np.zeros((150, 0), np.float32), np.ones((150, 12), np.float32))
    )
    prepared, trained = train_partitions([without_features, make_partition_data(2, 6, 5), constant])
    assert [len(p.basis.components) > 0 for p in prepared] == [False, True, False]
    assert trained[0].curves.validation_mm == []
    assert trained[2].network.biases[-1].shape == (0,)


def test_the_progress_shows_what_a_constant_partition_misses_in_unseen_poses_alone():
    learned, split = make_partition_data(2, 6, 5), split_poses(np.arange(150), CONFIG.validation_fraction, CONFIG.seed)
    residuals = np.zeros((150, 6, 3), np.float32)
    residuals[split.validation] = 0.01
    constant = PartitionData(np.ones((150, 0), np.float32), lambda: residuals)
    progress = []
    _, trained = train_partitions([learned, constant], on_epoch=lambda *errors: progress.append(errors))
    (epoch, training_mm, validation_mm), curve = progress[-1], trained[0].curves
    assert epoch == CONFIG.passes and training_mm == pytest.approx(curve.training_mm[-1] / 2)
    # Each coordinate of half of the vertices is off by 10 mm.
    assert validation_mm == pytest.approx(curve.validation_mm[-1] / 2 + 10 * 3**0.5 / 2)


def test_irrelevant_inputs_are_suppressed(monkeypatch):
    relevant = make_partition_data(4, 12, 8, poses=200)
    noise_features = np.random.default_rng(9).normal(size=(200, 80)).astype(np.float32)
    with_noise = replace(relevant, features=np.concatenate([relevant.features, noise_features], axis=1))
    config = replace(CONFIG, validation_fraction=0.3, weight_decay=0.2)

    def validation_error() -> float:
        return min(train_partitions([with_noise], config)[1][0].curves.validation_mm)

    rescaled_error = validation_error()
    monkeypatch.setattr("trainer.networks.loop.RELEVANCE_EPOCH_FRACTIONS", ())
    assert rescaled_error < 0.7 * validation_error()


def test_rescaling_inputs_keeps_the_best_outputs(monkeypatch):
    partitions = [make_partition_data(3, 10, 2), make_partition_data(5, 7, 1)]
    config = replace(CONFIG, passes=3)
    before = train_partitions(partitions, config)[1]
    loop_run = _Loop.run

    def run_and_rescale(loop: _Loop, *arguments) -> None:
        loop_run(loop, *arguments)
        loop.rescale_inputs_by_relevance()

    monkeypatch.setattr(_Loop, "run", run_and_rescale)
    prepared, after = train_partitions(partitions, config)
    for data, *partitions in zip(prepared, before, after, strict=True):
        expected, actual = (partition.network.evaluate(data.inputs) for partition in partitions)
        np.testing.assert_allclose(actual, expected, atol=1e-5 * np.abs(expected).max())


def test_a_warm_start_keeps_the_outputs():
    partitions = [make_partition_data(3, 10, 2), make_partition_data(5, 7, 1)]
    prepared, first = train_partitions(partitions)
    paused_config = replace(CONFIG, passes=10, learning_rate=1e-12)
    restarted = train_partitions(partitions, paused_config, initial=[p.network for p in first])[1]
    for partition, former in zip(restarted, first, strict=True):
        np.testing.assert_allclose(partition.curves.validation_mm, min(former.curves.validation_mm), rtol=1e-3)
    for data, *partitions in zip(prepared, first, restarted, strict=True):
        expected, actual = (partition.network.evaluate(data.inputs) for partition in partitions)
        np.testing.assert_allclose(actual, expected, atol=1e-5 * np.abs(expected).max())


def test_parameters_equal_those_of_torch():
    command = [sys.executable, "-m", "tests.trainer.optimizer_comparison"]
    assert subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout == "equal\n"


def test_a_warm_up_of_one_step_starts_at_the_maximum():
    optimizer = OneCycleAdamW([torch.nn.Parameter(torch.zeros(1))], 0.01, 0.0, total_steps=4, warm_up_fraction=0.25)
    assert optimizer.schedule(0) == (0.01, MIN_BETA_1)
    assert optimizer.schedule(1)[0] < 0.01


CARD = "GeForce GTX 960M"


@pytest.fixture(autouse=True)
def fresh_choice() -> Iterator[None]:
    choose_device.cache_clear()
    yield
    choose_device.cache_clear()


def raise_error(error: Exception) -> None:
    raise error


@pytest.mark.parametrize(
    ("error", "problem"),
    [
        (
            torch.AcceleratorError("CUDA error: no kernel image is available for execution on the device\nSearch for"),
            "CUDA error: no kernel image is available for execution on the device",
        ),
        (
            RuntimeError("CUDA error: all CUDA-capable devices are busy or unavailable\n"),
            "CUDA error: all CUDA-capable devices are busy or unavailable",
        ),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB. GPU 0 has"), "CUDA out of memory"),
        (AssertionError("Torch not compiled with CUDA enabled"), "Torch not compiled with CUDA enabled"),
    ],
)
def test_a_card_that_cannot_run_a_kernel_is_not_chosen(monkeypatch: pytest.MonkeyPatch, error: Exception, problem: str):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _index: CARD)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: raise_error(error))
    ones = torch.ones
    monkeypatch.setattr(torch, "ones", lambda *shape, device, **options: ones(*shape, **options))
    assert choose_device() == TrainingDevice(CPU, CARD, problem)
    choose_device.cache_clear()
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    assert choose_device() == TrainingDevice(GPU, CARD)


def test_a_driver_that_is_too_old_is_named(monkeypatch: pytest.MonkeyPatch):
    text = "CUDA initialization: The NVIDIA driver on your system is too old (found version 11040). Please update"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: bool(warnings.warn(text, stacklevel=1)))
    problem = "CUDA initialization: The NVIDIA driver on your system is too old (found version 11040)"
    assert choose_device() == TrainingDevice(CPU, "the graphics card", problem)


def test_the_cpu_trains_what_a_card_fails_to_train(
    recording: Path, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    """The device "meta" has no memory, so the training fails on it after its first steps."""
    monkeypatch.setattr("trainer.train.choose_device", lambda: TrainingDevice("meta", CARD))
    assert main([str(recording), str(tmp_path / "model.onnx"), *QUICK_OPTIONS]) == 0
    messages = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    (text,) = [message["text"] for message in messages if message.get("name") == "graphics-card"]
    assert text.startswith(f"{CARD} cannot be used (") and text.endswith(
        "), so the CPU trains this model, more slowly."
    )
    assert [message["device"] for message in messages if message["type"] == "started"] == ["meta"]
    assert json.loads((tmp_path / "report.json").read_text())["training"]["device"] == CPU
    assert (tmp_path / "model.onnx").read_bytes() == (trained / "model.onnx").read_bytes()
