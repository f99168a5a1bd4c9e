# SPDX-License-Identifier: GPL-3.0-or-later
"""The model takes values of controls as inputs, and learns residuals that depend on controls."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest

from fdda_addon.core.controls import Control
from fdda_addon.core.errors import ModelError
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.mathematics.metrics import distances
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.rig import Rig
from fdda_addon.runtime.network import Network
from trainer.__main__ import main
from trainer.config import TrainingConfig
from trainer.data.split import split_recording
from trainer.inputs.network_inputs import make_inputs
from trainer.networks.confidence import measure_training_range

from ..recordings import read_skinned, write_recording
from .chain import chain_angles, chain_info, chain_residuals, chain_rig, pose_chain
from .conftest import QUICK_OPTIONS

POSES = 150
BULGE = Control("shape_keys", 'key_blocks["Bulge"].value', 0, 1)
PUFF = Control("armature_object", '["puff"]', -2, 2)
LOCKED = Control("armature", '["locked"]', 0.5, 0.5)
INFLUENCING = {0: (), 1: (1, 2), 2: (2,)}
CONTROLS_BY_PARTITION = {0: (1,), 1: (0,), 2: (0,)}
"""Controls that influence each partition. No joint influences the first partition."""


def controlled_rig(*controls: Control) -> Rig:
    return replace(chain_rig(), controls=controls or (BULGE, PUFF, LOCKED))


def controlled_poses(poses: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw (poses, 3, 2) angles, and (poses, 3) values of the controls in nine tenths of their ranges."""
    values = np.random.default_rng([seed, 1]).uniform(-1, 1, (poses, 3)) * [0.45, 1.8, 0] + [0.5, 0, 0.5]
    return chain_angles(poses, 3, seed), values.astype(np.float32)


def controlled_residuals(rig: Rig, angles: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return (N, V, 3) residuals: the chain's, but 0 at its first joint, plus centimeters that depend on controls."""
    position = rig.rest_positions[:, 2] * 3
    residuals = chain_residuals(rig, angles)
    first = make_partitions(rig)[0].vertices
    residuals[:, first] = 0
    residuals[:, first, 1] = np.sin(values[:, 1:2]) * 0.015 * position[first]
    others = np.setdiff1d(np.arange(rig.vertex_count), first)
    residuals[:, others, 0] += values[:, :1] * 0.03 * np.exp(-((position[others] - 2) ** 2))
    return residuals


def write_controlled_recording(path: Path, rig: Rig) -> Path:
    angles, values = controlled_poses(POSES, 0)
    write_recording(
        path,
        rig,
        make_partitions(rig, INFLUENCING, CONTROLS_BY_PARTITION),
        chain_info(POSES),
        pose_chain(rig, angles),
        controlled_residuals(rig, angles, values),
        values,
    )
    return path


@pytest.fixture(scope="module")
def controlled_recording(tmp_path_factory) -> Path:
    return write_controlled_recording(tmp_path_factory.mktemp("controls") / "recording", controlled_rig())


@pytest.fixture(scope="module")
def model(controlled_recording) -> Path:
    path = controlled_recording.parent / "model.onnx"
    assert main([str(controlled_recording), str(path), *QUICK_OPTIONS, "--passes", "100"]) == 0
    return path


@pytest.fixture(scope="module")
def network(model) -> Network:
    return Network(model)


def test_the_model_needs_the_values_of_controls(network, model):
    rig, (angles, values) = controlled_rig(), controlled_poses(50, 9)
    poses, skinning = pose_chain(rig, angles), LinearSkinning(rig)
    truth = skinning.complex_positions(poses, controlled_residuals(rig, angles, values))
    error, linear = distances(network.positions(poses, values), truth), distances(skinning.positions(poses), truth)
    for partition in make_partitions(rig):
        assert error[:, partition.vertices].mean() < 0.1 * linear[:, partition.vertices].mean()
    mean_values = np.tile(values.mean(axis=0), (50, 1))
    assert distances(network.positions(poses, mean_values), truth).mean() > 5 * error.mean()
    report = json.loads(model.with_name("report.json").read_text())
    assert 0.5 < report["fdda"]["held_out"]["mean"] / (error.mean() * 1000) < 2


def test_the_graph_has_the_controls_input_only_with_controls(model, trained):
    def inputs(path: Path) -> dict[str, list]:
        return {
            i.name: [d.dim_value or d.dim_param for d in i.type.tensor_type.shape.dim]
            for i in onnx.load(path).graph.input
        }

    assert inputs(model) == {"pose_matrices": ["N", 3, 4, 4], "controls": ["N", 3]}
    assert inputs(trained / "model.onnx") == {"pose_matrices": ["N", 3, 4, 4]}
    assert read_model_info(trained / "model.onnx").controls == ()


def test_metadata_has_the_ranges_of_the_training_poses(model, controlled_recording):
    info, recording = read_model_info(model), read_skinned(controlled_recording)
    values = recording.controls[split_recording(recording, TrainingConfig()).training]
    assert [c.name for c in info.controls] == [c.name for c in (BULGE, PUFF, LOCKED)]
    assert [c.low for c in info.controls] == values.min(axis=0).tolist()
    assert [c.high for c in info.controls] == values.max(axis=0).tolist()
    assert info.controls[0].low > 0.04 and info.controls[2].low == info.controls[2].high == 0.5
    assert [p.controls for p in info.partitions] == [(1,), (0,), (0,)]
    assert 0 < info.parity_mm < 1e-2


def test_the_report_names_controls(model):
    report = json.loads(model.with_name("report.json").read_text())
    assert report["controls"] == [c.name for c in (BULGE, PUFF, LOCKED)]
    assert [p["controls"] for p in report["partitions"]] == [[PUFF.name], [BULGE.name], [BULGE.name]]
    page = model.with_name("report.html").read_text()
    assert "<th>controls</th>" in page and '<td title="armature_object/[&#34;puff&#34;]">1</td>' in page


def confidence_of_control(network: Network, control: int, values: np.ndarray) -> np.ndarray:
    """Return the (N, 3) confidence in the rest pose for values of one control; the other controls are centered."""
    controls = np.tile(np.float32([0.5, 0, 0.5]), (len(values), 1))
    controls[:, control] = values
    return network.confidence(np.tile(network.info.rest_matrices, (len(values), 1, 1, 1)), controls)


def test_confidence_fades_beyond_the_range_of_a_control(network):
    confidence = confidence_of_control(network, 1, np.linspace(0, 96, 240))
    assert (confidence[:4, 0] == 1).all() and confidence[-1, 0] == 0
    assert (np.diff(confidence[:, 0]) <= 0).all() and np.abs(np.diff(confidence, axis=0)).max() < 0.05
    assert (confidence[:, 1:] == 1).all(), "the other partitions do not follow this control"
    # Far outside the range only linear skinning remains.
    rest = network.info.rest_matrices[None]
    far = network.positions(rest, np.float32([[0.5, 200, 0.5]]))[0]
    rig = controlled_rig()
    first = make_partitions(rig)[0].vertices
    np.testing.assert_allclose(far[first], rig.rest_positions[first], atol=1e-6)


def test_a_shape_key_is_linear_in_any_range(network):
    """The key was recorded between 0.05 and 0.95. Bends of the joints that the fit leaves make it inexact."""
    rig, values = controlled_rig(), np.float32([-20, 0.5, 50])
    assert (confidence_of_control(network, 0, values) == 1).all()
    poses, controls = pose_chain(rig, np.repeat(chain_angles(1, 3, 5), 3, axis=0)), np.float32([[0, 0, 0.5]] * 3)
    controls[:, 0] = values
    positions = network.positions(poses, controls).astype(np.float64)
    truth = controlled_residuals(rig, np.zeros((1, 3, 2)), np.float32([[1, 0, 0.5]]))[0]
    others = np.concatenate([p.vertices for p in make_partitions(rig)[1:]])
    per_unit = np.linalg.norm((positions[2] - positions[0]) / 70, axis=1)
    np.testing.assert_allclose(per_unit[others], np.abs(truth[others, 0]), atol=2e-3)


def test_a_shape_key_is_fitted_where_it_has_an_effect(tmp_path):
    """The first key also moves a partition beside its own. The second key moves nothing."""
    rig = controlled_rig(BULGE, replace(BULGE, path='key_blocks["Idle"].value'))
    angles, values = controlled_poses(POSES, 0)
    values = np.stack([values[:, 0], np.random.default_rng(1).uniform(0, 1, POSES)], axis=1).astype(np.float32)
    partitions = make_partitions(rig, INFLUENCING, {1: (0, 1), 2: (1,)})
    zeros = np.zeros((POSES, 1))
    residuals = controlled_residuals(rig, angles, np.concatenate([values[:, :1], zeros, zeros], axis=1))
    arrays = pose_chain(rig, angles), residuals, values
    write_recording(tmp_path / "recording", rig, partitions, chain_info(POSES), *arrays)
    assert main([str(tmp_path / "recording"), str(tmp_path / "model.onnx"), *QUICK_OPTIONS]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert [p.get("linear_keys") for p in report["partitions"]] == [None, [BULGE.name], [BULGE.name]]


def test_a_control_that_never_moved_lowers_confidence_only_when_it_moves(network):
    confidence = confidence_of_control(network, 2, np.float32([0.5, 0.7, 3, 15]))
    assert (confidence[0] == 1).all()
    assert (np.diff(confidence, axis=0) < 0).all() and (confidence[-1] == 0).all(), "its effect is unknown"


def test_a_constant_control_with_a_range_counts_where_it_influences():
    rig = controlled_rig(BULGE)
    partitions = make_partitions(rig, INFLUENCING, {1: (0,)})
    inputs = make_inputs(rig, partitions)
    poses, constant_values = pose_chain(rig, chain_angles(20, 3, 0)), np.full((20, 1), 0.25)
    features = inputs.compute_features(poses, constant_values)
    training_range = measure_training_range(features, inputs.length_mask(), rig, partitions)
    assert training_range.controls == (replace(BULGE, low=0.25, high=0.25),)
    confidence = training_range.compute_confidence(inputs.compute_features(poses[:3], np.array([[0.25], [1], [16]])))
    assert (
        (confidence[:, [0, 2]] == 1).all() and confidence[0, 1] == 1 > confidence[1, 1] > 0.8 and confidence[2, 1] == 0
    )


def test_values_of_controls_must_be_given(network):
    rest = np.repeat(network.info.rest_matrices[None], 2, axis=0)
    for evaluate in (network.positions, network.confidence):
        with pytest.raises(
            ModelError, match=r"has 3 controls and takes their values as an array \(2, 3\);.* given none"
        ):
            evaluate(rest)
        with pytest.raises(ModelError, match=r"it was given \(3,\)\."):
            evaluate(rest, np.zeros(3, np.float32))


def test_each_pose_of_a_batch_has_its_own_control_values(network):
    angles, values = controlled_poses(6, 4)
    poses = pose_chain(controlled_rig(), angles)
    batch_positions = network.positions(poses, values).copy()
    for index in (0, 5):
        single_positions = network.positions(poses[index : index + 1], values[index : index + 1])
        np.testing.assert_allclose(single_positions[0], batch_positions[index], atol=2e-6)
    assert np.abs(network.positions(poses, values[::-1]) - batch_positions).max() > 1e-3


def test_a_warm_start_requires_the_same_controls(controlled_recording, model, tmp_path, capsys):
    for path in (model, model.with_suffix(".checkpoint.npz")):
        shutil.copy(path, tmp_path)
    model_copy = tmp_path / "model.onnx"
    error_before = json.loads(model.with_name("report.json").read_text())["fdda"]["held_out"]["mean"]
    assert main([str(controlled_recording), str(model_copy), *QUICK_OPTIONS, "--passes", "10", "--warm-start"]) == 0
    error_after = json.loads((tmp_path / "report.json").read_text())["fdda"]["held_out"]["mean"]
    assert error_after < 1.5 * error_before
    reordered_rig = controlled_rig(PUFF, BULGE, LOCKED)
    write_controlled_recording(tmp_path / "other", reordered_rig)
    assert main([str(tmp_path / "other"), str(model_copy), *QUICK_OPTIONS, "--warm-start"]) == 1
    assert "is of other controls; train without --warm-start." in capsys.readouterr().err


def test_the_holdout_fingerprint_depends_on_controls(controlled_recording, model, tmp_path, capsys):
    for path in (model, model.with_suffix(".checkpoint.npz")):
        shutil.copy(path, tmp_path)
    shutil.copytree(controlled_recording, tmp_path / "recording")
    values = np.load(tmp_path / "recording" / "controls.npy")
    np.save(tmp_path / "recording" / "controls.npy", values[::-1].copy())
    assert main([str(tmp_path / "recording"), str(tmp_path / "model.onnx"), *QUICK_OPTIONS, "--warm-start"]) == 1
    assert "may have been trained on poses that are held out now" in capsys.readouterr().err
