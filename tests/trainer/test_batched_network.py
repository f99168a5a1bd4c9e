# SPDX-License-Identifier: GPL-3.0-or-later
"""The batched network and its loop: padding changes nothing, training learns, and a seed decides everything."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from trainer.config import TrainingConfig
from trainer.data import PartitionData, prepare, split_poses
from trainer.loop import _Loop, train
from trainer.model import ACTIVATIONS, PartitionNetworks
from trainer.process import Cancelled

from .chain import chain_angles

CONFIG = TrainingConfig(epochs=30, hidden=(16, 16), batch_size=16, tolerance_mm=0.01, learning_rate=0.01)


def partition(inputs: int, vertices: int, seed: int, poses: int = 150) -> PartitionData:
    """Residuals of some millimetres that depend smoothly on the features."""
    features = np.sin(chain_angles(poses, inputs + 1, seed)[:, 1:, 0]).astype(np.float32)
    rng = np.random.default_rng(seed)
    values = np.tanh(features @ rng.normal(size=(inputs, 4))) @ rng.normal(size=(4, 3 * vertices)) * 0.002
    residuals = values.reshape(poses, vertices, 3).astype(np.float32)
    return PartitionData(f"p{inputs}", features, lambda: residuals, vertices)


def learn(partitions, config=CONFIG, **options):
    split = split_poses(np.arange(len(partitions[0].features)), config.validation_fraction, config.seed)
    prepared = [prepare(p, split, config.tolerance_mm, config.seed) for p in partitions]
    return prepared, train(prepared, split, config, torch.device("cpu"), **options)


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_padding_changes_no_output(activation):
    generator = torch.Generator().manual_seed(0)
    model = PartitionNetworks([3, 7], [5, 2], (8, 6), activation, 0.0, generator)
    inputs = torch.randn(2, 4, 7, generator=generator)
    inputs[0, :, 3:] = 0
    outputs = model(inputs)
    values = inputs[0, :, :3]
    for layer in range(3):
        weight = model.weights[layer][0][:3] if layer == 0 else model.weights[layer][0]
        values = values @ weight + model.biases[layer][0]
        if layer < 2:
            values = ACTIVATIONS[activation](values)
    torch.testing.assert_close(outputs[0], values)
    assert outputs[1, :, 2:].abs().max() == 0


def test_dropout_drops_only_with_a_generator():
    model = PartitionNetworks([4], [3], (64,), "relu", 0.5, torch.Generator().manual_seed(0))
    inputs = torch.ones(1, 2, 4)
    torch.testing.assert_close(model(inputs), model(inputs))
    dropped = model(inputs, torch.Generator().manual_seed(1))
    assert not torch.allclose(dropped, model(inputs))


def test_training_learns_every_partition():
    prepared, trained = learn([partition(2, 12, 0), partition(5, 7, 1)])
    for data, network, curve in zip(prepared, trained.networks, trained.curves, strict=True):
        assert min(curve.validation_mm) < 0.15 * data.residual_rms * 1000
        assert curve.validation_mm[curve.best_epoch - 1] == min(curve.validation_mm)
        assert [w.shape[0] for w in network.weights] == [data.inputs.shape[1], 16, 16]
        assert network.weights[-1].shape[1] == len(data.basis.shapes)


def test_returned_weights_are_those_of_the_best_epoch():
    prepared, trained = learn([partition(3, 10, 2)])
    split = split_poses(np.arange(150), CONFIG.validation_fraction, CONFIG.seed)
    coefficients = trained.networks[0].coefficients(prepared[0].inputs[split.validation], CONFIG.activation)
    squared = ((coefficients - prepared[0].coefficients[split.validation]) ** 2).sum(axis=1) / 10
    error = np.sqrt(squared + prepared[0].validation_truncation ** 2).mean() * 1000
    assert error == pytest.approx(min(trained.curves[0].validation_mm), rel=1e-3)


def test_one_seed_gives_the_same_weights_and_another_does_not():
    partitions = [partition(3, 10, 2), partition(2, 5, 3)]
    config = TrainingConfig(epochs=3, hidden=(8,), batch_size=16, dropout=0.1)
    first, second = (learn(partitions, config)[1].networks for _ in range(2))
    for one, other in zip(first, second, strict=True):
        for a, b in zip((*one.weights, *one.biases), (*other.weights, *other.biases), strict=True):
            np.testing.assert_array_equal(a, b)
    reseeded = TrainingConfig(seed=1, epochs=3, hidden=(8,), batch_size=16, dropout=0.1)
    assert not np.array_equal(learn(partitions, reseeded)[1].networks[0].weights[0], first[0].weights[0])


def test_a_partition_without_inputs_keeps_its_mean():
    still = PartitionData("still", np.zeros((150, 0), np.float32), partition(2, 6, 4).read_residuals, 6)
    constant = PartitionData("constant", np.ones((150, 12), np.float32), partition(2, 6, 4).read_residuals, 6)
    prepared, trained = learn([still, partition(2, 6, 5), constant])
    assert [len(p.basis.shapes) > 0 for p in prepared] == [False, True, False]
    assert trained.curves[0].validation_mm == []
    assert trained.networks[2].biases[-1].shape == (0,)


def test_penalties_shrink_the_weights():
    def size(**penalty) -> float:
        config = TrainingConfig(epochs=10, hidden=(8,), batch_size=16, weight_decay=0, **penalty)
        return float(np.abs(learn([partition(3, 5, 6)], config)[1].networks[0].weights[0]).sum())

    assert size(l1=1e-2) < 0.9 * size()
    assert size(l2=1e-2) < 0.9 * size()


def test_inputs_that_say_nothing_are_found_out(monkeypatch):
    said = partition(4, 12, 8, poses=200)
    needless = np.random.default_rng(9).normal(size=(200, 80)).astype(np.float32)
    crowded = replace(said, features=np.concatenate([said.features, needless], axis=1))
    config = replace(CONFIG, validation_fraction=0.3, weight_decay=0.2)

    def error() -> float:
        return min(learn([crowded], config)[1].curves[0].validation_mm)

    weighed = error()
    monkeypatch.setattr("trainer.loop.WEIGHED_AFTER", ())
    assert weighed < 0.7 * error()


def test_weighing_inputs_changes_no_best_answer(monkeypatch):
    partitions = [partition(3, 10, 2), partition(5, 7, 1)]
    config = replace(CONFIG, epochs=3, averaging=0)
    before = learn(partitions, config)[1]
    loop_run = _Loop.run

    def run_and_weigh(loop: _Loop, *arguments) -> None:
        loop_run(loop, *arguments)
        loop.weigh_inputs()

    monkeypatch.setattr(_Loop, "run", run_and_weigh)
    prepared, after = learn(partitions, config)
    for data, one, other in zip(prepared, before.networks, after.networks, strict=True):
        expected, given = (network.coefficients(data.inputs, "silu") for network in (one, other))
        np.testing.assert_allclose(given, expected, atol=1e-5 * np.abs(expected).max())


def test_a_training_from_networks_starts_with_their_answers():
    partitions = [partition(3, 10, 2), partition(5, 7, 1)]
    prepared, first = learn(partitions)
    still = replace(CONFIG, epochs=10, learning_rate=1e-12, averaging=0)
    again = learn(partitions, still, initial=first.networks)[1]
    for curve, begun in zip(again.curves, first.curves, strict=True):
        np.testing.assert_allclose(curve.validation_mm, min(begun.validation_mm), rtol=1e-3)
    for data, one, other in zip(prepared, first.networks, again.networks, strict=True):
        expected, given = (network.coefficients(data.inputs, "silu") for network in (one, other))
        np.testing.assert_allclose(given, expected, atol=1e-5 * np.abs(expected).max())


def test_patience_stops_early():
    seen = []
    config = TrainingConfig(epochs=60, hidden=(8,), batch_size=16, learning_rate=1e-9, averaging=0, patience=3)
    noise = PartitionData(
        "noise",
        np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32),
        lambda: np.random.default_rng(1).normal(size=(60, 4, 3)).astype(np.float32),
        4,
    )
    learn([noise], config, progress=seen.append)
    assert len(seen) < 60


def test_a_request_to_stop_is_heeded():
    asked = []

    def stop() -> bool:
        asked.append(True)
        return len(asked) > 5

    with pytest.raises(Cancelled):
        learn([partition(2, 5, 7)], should_stop=stop)
    assert len(asked) == 6
