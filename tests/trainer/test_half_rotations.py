# SPDX-License-Identifier: GPL-3.0-or-later
"""Half-rotation features are used only for rigs that blend rotations; the graph computes the same values."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
from scipy.spatial.transform import Rotation

from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.formats.report import checkpoint_path
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.mathematics.skinning import LinearSkinning, skin_matrices
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import Rig
from trainer.__main__ import main
from trainer.config import TrainingConfig
from trainer.data.split import split_recording
from trainer.export.export import build_graph
from trainer.fits.half_rotations import half_rotation_matrices, half_rotations_help, regression_matrices
from trainer.fits.joint_fit import JointFit, joint_regression
from trainer.model import TrainedModel

from ..recordings import read_skinned, write_recording
from .chain import chain_angles, chain_info, chain_rig, pose_chain, rotation, write_chain
from .conftest import QUICK_OPTIONS, train_model
from .test_graph import check_agreement, constant_bytes
from .tube import write_tube

POSES, RANGE_SCALE = 160, 1.8
INFLUENCING = {0: (1,), 1: (1, 2), 2: (1, 2)}


def blend_rotations(rig: Rig, pose_matrices: np.ndarray) -> np.ndarray:
    """Return (N, V, 3) positions skinned with dual quaternions, as by an armature that preserves volume."""
    skin = skin_matrices(pose_matrices, rig.rest_matrices).astype(np.float64)
    real = Rotation.from_matrix(skin[:, :, :3, :3].reshape(-1, 3, 3)).as_quat(scalar_first=True)
    real = real.reshape(len(skin), -1, 4)
    dual = 0.5 * multiply_quaternions(np.pad(skin[:, :, :3, 3], ((0, 0), (0, 0), (1, 0))), real)
    first = real[:, rig.skin_joints[:, :1]]
    real, dual = real[:, rig.skin_joints], dual[:, rig.skin_joints]
    weights = rig.skin_weights[None, :, :, None] * np.where((first * real).sum(axis=3, keepdims=True) < 0, -1, 1)
    real, dual = ((weights * quaternions).sum(axis=2) for quaternions in (real, dual))
    lengths = np.linalg.norm(real, axis=2, keepdims=True)
    real, dual = real / lengths, dual / lengths
    translations = 2 * multiply_quaternions(dual, real * [1, -1, -1, -1])[..., 1:]
    rotations = Rotation.from_quat(real.reshape(-1, 4), scalar_first=True)
    rest = np.broadcast_to(rig.rest_positions, translations.shape).reshape(-1, 3)
    return rotations.apply(rest).reshape(translations.shape) + translations


def multiply_quaternions(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Multiply quaternions (..., 4), the scalar first."""
    scalar = first[..., 0] * second[..., 0] - (first[..., 1:] * second[..., 1:]).sum(axis=-1)
    vector = first[..., :1] * second[..., 1:] + second[..., :1] * first[..., 1:]
    return np.append(scalar[..., None], vector + np.cross(first[..., 1:], second[..., 1:]), axis=-1)


def write_volume_recording(
    path: Path, units_per_metre: float = 1.0, origin_distance: float = 0.0, slanted_scale: np.ndarray | None = None
) -> SkinnedRecording:
    """Write a recording of the chain with an armature that preserves volume."""
    plain_rig, slanted_scale = chain_rig(), np.eye(4) if slanted_scale is None else slanted_scale
    poses = pose_chain(plain_rig, chain_angles(POSES, 3, seed=2, range_scale=RANGE_SCALE))
    positions = blend_rotations(plain_rig, poses)
    rest_matrices, poses = slanted_scale @ plain_rig.rest_matrices, slanted_scale @ poses
    rest_positions, positions = (points @ slanted_scale[:3, :3].T for points in (plain_rig.rest_positions, positions))
    for matrices in (rest_matrices, poses):
        matrices[..., :3, 3] = units_per_metre * (matrices[..., :3, 3] + origin_distance)
    rest_positions, positions = (units_per_metre * (points + origin_distance) for points in (rest_positions, positions))
    rig = replace(
        plain_rig,
        rest_matrices=rest_matrices.astype(np.float32),
        rest_positions=rest_positions.astype(np.float32),
        metres_per_unit=1 / units_per_metre,
    )
    residuals = LinearSkinning(rig).local_residuals(poses.astype(np.float32), positions)
    write_recording(
        path, rig, make_partitions(rig, INFLUENCING), chain_info(POSES), poses.astype(np.float32), residuals
    )
    return read_skinned(path)


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> SkinnedRecording:
    return write_volume_recording(tmp_path_factory.mktemp("volumes") / "volume")


@pytest.fixture(scope="module")
def model_and_path(recording, tmp_path_factory) -> tuple:
    """A trained model and the path of its file."""
    path = tmp_path_factory.mktemp("models") / "volume.onnx"
    return train_model(recording.path, path), path


def half_rotations_are_selected(recording: SkinnedRecording) -> bool:
    return half_rotations_help(recording, split_recording(recording, TrainingConfig()).training)


def pose_second_joint(rig: Rig, matrix: np.ndarray) -> np.ndarray:
    """Return (1, J, 4, 4) pose matrices with a transform of the second joint relative to the first."""
    rest_matrices = rig.rest_matrices.astype(np.float64)
    poses = rest_matrices.copy()
    poses[0] = rotation(1, 0.4) @ rest_matrices[0]
    poses[1] = poses[0] @ np.linalg.inv(rest_matrices[0]) @ rest_matrices[1] @ matrix
    poses[2] = poses[1] @ np.linalg.inv(rest_matrices[1]) @ rest_matrices[2]
    return poses[None].astype(np.float32)


@pytest.mark.parametrize("degrees", [-120, -60, 1, 30, 90, 120])
def test_a_half_rotation_is_proportional_to_the_sine_of_half_the_angle(degrees):
    rig, angle = chain_rig(), np.radians(degrees)
    poses = pose_second_joint(rig, rotation(0, angle))
    half_rotations = half_rotation_matrices(poses, rig)[0]
    axis_matrix = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]])
    carried = poses[0, 0, :3, :3] @ np.linalg.inv(rig.rest_matrices[0, :3, :3])
    rest = rig.rest_matrices[1, :3, :3]
    for factor, tolerance in ((np.sin(angle) / (2 + np.cos(angle)), 1e-6), (0.687 * np.sin(angle / 2), 0.03)):
        expected = carried @ rest @ (factor * axis_matrix) @ np.linalg.inv(rest)
        np.testing.assert_allclose(half_rotations[1], expected, atol=tolerance * max(abs(factor), 1e-3))
    # A root has no half rotation, and the third joint does not rotate relative to the second.
    assert not half_rotations[0].any() and np.abs(half_rotations[2]).max() < 1e-6


def test_half_rotations_rotate_with_the_character():
    rig = chain_rig()
    poses = pose_chain(rig, chain_angles(5, 3, seed=3)).astype(np.float64)
    character_transform = rotation(0, 0.7) @ rotation(2, -1.9)
    character_transform[:3, 3] = 30, -20, 10
    rotated = regression_matrices((character_transform @ poses).astype(np.float32), rig, use_half_rotations=True)[:, 3:]
    expected = (
        character_transform[:3, :3] @ regression_matrices(poses.astype(np.float32), rig, use_half_rotations=True)[:, 3:]
    )
    np.testing.assert_allclose(rotated, expected, atol=1e-5)
    assert not rotated[..., 3].any() and np.abs(rotated).max() > 0.1


@pytest.mark.parametrize("matrix", [rotation(0, np.pi), np.diag([100, 100, 100, 1]), np.diag([-1, -1, -1, 1])])
def test_half_rotations_are_bounded(matrix):
    """The cases are 180 degrees, a joint scaled by a hundred, and a mirrored joint, whose divisor would be 0."""
    rig = chain_rig()
    assert np.abs(half_rotation_matrices(pose_second_joint(rig, matrix), rig)).max() < 1e-4


def test_half_rotations_explain_most_residuals_of_preserved_volume(recording):
    split = split_recording(recording, TrainingConfig())
    for partition in recording.partitions:
        residuals, mean_squares = recording.residuals[:, partition.vertices], []
        for use_half_rotations in (False, True):
            matrices = regression_matrices(recording.pose_matrices, recording.rig, use_half_rotations)
            regression = joint_regression(recording.rig, partition, matrices)
            fit, remainder = regression.fit(residuals, split.training)
            mean_squares.append(float((remainder[split.held_out].astype(np.float64) ** 2).mean()))
            offsets = fit.compute_offsets(matrices) @ np.linalg.inv(matrices[:, partition.joint, :, :3]).transpose(
                0, 2, 1
            )
            np.testing.assert_allclose(residuals - offsets, remainder, atol=1e-5)
        assert (fit.joints >= len(recording.rig.joints)).any()
        assert mean_squares[1] < 0.25 * mean_squares[0]


@pytest.mark.parametrize("units_per_metre, origin_distance", [(1000.0, 0.0), (1.0, 100.0), (1000.0, 100.0)])
def test_selection_does_not_depend_on_unit_and_position(tmp_path, recording, units_per_metre, origin_distance):
    moved_recording = write_volume_recording(tmp_path / "volume", units_per_metre, origin_distance)
    assert half_rotations_are_selected(recording) and half_rotations_are_selected(moved_recording)
    selected_joints = []
    for tested_recording in (recording, moved_recording):
        matrices = regression_matrices(tested_recording.pose_matrices, tested_recording.rig, use_half_rotations=True)
        partition = tested_recording.partitions[1]
        regression = joint_regression(tested_recording.rig, partition, matrices)
        selected_joints.append(
            regression.fit(tested_recording.residuals[:, partition.vertices], np.arange(POSES))[0].joints.tolist()
        )
    assert selected_joints[0] == selected_joints[1]


def test_a_rig_that_blends_matrices_has_no_half_rotations(tmp_path):
    """The cases are bulges that grow with the bend, skinning alone, and delta mush, which has surface frames."""
    write_chain(tmp_path / "chain")
    bulges = read_skinned(tmp_path / "chain")
    assert not half_rotations_are_selected(bulges) and not half_rotations_are_selected(
        replace(bulges, residuals=0 * bulges.residuals)
    )
    write_tube(tmp_path / "tube")
    assert main([str(tmp_path / "tube"), str(tmp_path / "tube.onnx"), *QUICK_OPTIONS]) == 0
    names = {node.name for node in onnx.load(tmp_path / "tube.onnx").graph.node}
    assert "surface_frame_features" in names and "half_rotation_matrices" not in names


def without_half_rotations(trained_model: TrainedModel) -> TrainedModel:
    """Return the trained model without the half-rotation matrices of its fits."""
    prepared = []
    for partition in trained_model.prepared:
        count = int((partition.fit.joints < len(trained_model.rig.joints)).sum())
        prepared.append(
            replace(partition, fit=JointFit(partition.fit.joints[:count], partition.fit.factors[: 4 * count]))
        )
    return replace(trained_model, prepared=tuple(prepared))


def test_a_warm_start_keeps_half_rotations(recording, model_and_path, tmp_path, capsys):
    trained_model, model_path = model_and_path
    path = tmp_path / model_path.name
    for file in (model_path, checkpoint_path(model_path)):
        shutil.copy(file, tmp_path)
    assert trained_model.half_rotation_joints().tolist() == [1, 2] and read_model_info(path).parity_mm < 1e-2
    assert main([str(recording.path), str(path), *QUICK_OPTIONS, "--warm-start"]) == 0
    assert "The rig blends rotations" in capsys.readouterr().out
    report = json.loads((path.parent / "report.json").read_text())
    assert report["fdda"]["held_out"]["mean"] < 0.1 * report["linear"]["held_out"]["mean"]


def test_half_rotations_cost_thirteen_nodes_and_three_parameters_per_vertex(model_and_path):
    trained_model = model_and_path[0]
    graph, plain = (
        build_graph(tested_model) for tested_model in (trained_model, without_half_rotations(trained_model))
    )
    assert len(graph.graph.node) == len(plain.graph.node) + 13
    counts = [(int((p.fit.joints >= 3).sum()), p.vertex_count) for p in trained_model.prepared]
    parameter_count = 3 * sum(joint_count * vertex_count for joint_count, vertex_count in counts)
    assert 4 * parameter_count < constant_bytes(graph) - constant_bytes(plain) < 4 * parameter_count + 2_000


def test_the_graph_agrees_with_pytorch(model_and_path):
    trained_model = model_and_path[0]
    poses = pose_chain(trained_model.rig, chain_angles(20, 3, seed=5, range_scale=1.2 * RANGE_SCALE))
    check_agreement(trained_model, poses)
    poses[:, 1:] = poses[:, 1:] @ np.diag([1.1, 0.9, 1.05, 1]).astype(np.float32)
    check_agreement(trained_model, poses)
    # With a mirrored joint, the divisor would be negative.
    check_agreement(trained_model, pose_second_joint(trained_model.rig, np.diag([-3, -3, -3, 1])))


def test_sheared_bones_have_half_rotations(tmp_path):
    slanted_scale = rotation(0, 0.7) @ np.diag([1, 1, 0.6, 1]) @ rotation(0, -0.7)
    sheared = write_volume_recording(tmp_path / "volume", slanted_scale=slanted_scale)
    assert len(train_model(sheared.path, tmp_path / "model.onnx").half_rotation_joints())
    assert read_model_info(tmp_path / "model.onnx").parity_mm < 1e-2
