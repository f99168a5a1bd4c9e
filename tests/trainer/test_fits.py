# SPDX-License-Identifier: GPL-3.0-or-later
"""Linear fits, components and parts of partitions."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.controls import Control
from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.mathematics.partition import Partition, make_partitions
from fdda_addon.core.mathematics.skinning import LinearSkinning, skin_matrices
from fdda_addon.core.rig import Joint, Rig
from fdda_addon.runtime.network import Network
from trainer import preparation
from trainer.__main__ import main
from trainer.fits import basis as basis_module
from trainer.fits import parts
from trainer.fits.basis import allocate_components, make_basis
from trainer.fits.joint_fit import JointFit, joint_regression
from trainer.fits.parts import divide_by_mesh, divide_partition, mesh_of

from ..recordings import write_recording
from .chain import chain_angles, chain_info, chain_rig, pose_chain, rotation
from .conftest import QUICK_OPTIONS


def random_residuals(poses: int, vertices: int, rank: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    sizes = 0.01 * 0.5 ** np.arange(rank)
    components = np.linalg.qr(rng.normal(size=(3 * vertices, rank)))[0].T
    return (rng.normal(size=(poses, rank)) * sizes @ components + rng.normal(size=3 * vertices) * 0.01).astype(
        np.float32
    )


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values.astype(np.float64) ** 2).sum() * 3 / values.size))


@pytest.mark.parametrize("poses, vertices", [(60, 50), (200, 20)], ids=["gram", "covariance"])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-5, 1e-6])
def test_the_tolerance_determines_the_number_of_components(poses, vertices, tolerance, monkeypatch):
    monkeypatch.setattr(basis_module, "NEGLIGIBLE_RMS_RATIO", 0)
    values = random_residuals(poses, vertices, 12)
    basis = make_basis(values, tolerance, np.random.default_rng(0))
    error = rms(values - basis.reconstruct(basis.project(values)))
    assert error <= tolerance * 1.01
    assert basis.truncation_rms == pytest.approx(error, rel=0.02, abs=1e-8)
    coefficients = basis.project(values)[:, :-1]
    approximation = coefficients @ basis.components[:-1] + basis.mean
    assert rms(values - approximation) > tolerance
    assert 0 < len(basis.components) <= 12


def test_a_hundredth_of_the_residual_needs_no_components():
    values = random_residuals(60, 50, 12)
    basis = make_basis(values, 1e-9, np.random.default_rng(0))
    spread = rms(values - values.mean(axis=0))
    assert 0.002 * spread < basis.truncation_rms <= 0.01 * spread
    assert len(basis.components) < 12


def test_components_are_orthonormal_so_coefficients_measure_distance():
    values = random_residuals(80, 100, 10)
    basis = make_basis(values, 1e-6, np.random.default_rng(0))
    np.testing.assert_allclose(basis.components @ basis.components.T, np.eye(len(basis.components)), atol=1e-5)
    coefficients = basis.project(values)
    distance = np.linalg.norm(values[3].astype(np.float64) - values[4])
    assert np.linalg.norm(coefficients[3] - coefficients[4]) == pytest.approx(distance, rel=1e-3)


def test_a_sample_of_the_poses_gives_the_same_components(monkeypatch):
    monkeypatch.setattr(basis_module, "MAX_POSES", 50)
    monkeypatch.setattr(basis_module, "NEGLIGIBLE_RMS_RATIO", 0)
    values = random_residuals(150, 60, 6)
    basis = make_basis(values, 1e-6, np.random.default_rng(0))
    assert rms(values - basis.reconstruct(basis.project(values))) < 3e-6


def example_errors() -> tuple[list[np.ndarray], list[int]]:
    """Return the errors by number of components and the vertex counts of a simple, a complex and a small partition."""
    return [np.array(by_count) for by_count in ([1.0, 0.1, 0.02, 0.005], 0.8 ** np.arange(25), [0.5, 0.1, 0.05])], [
        400,
        40,
        10,
    ]


def common_error(errors: list[np.ndarray], vertex_counts: list[int], counts: list[int]) -> float:
    squared = sum(
        vertex_count * error_by_count[count] ** 2
        for error_by_count, vertex_count, count in zip(errors, vertex_counts, counts, strict=True)
    )
    return float(np.sqrt(squared / sum(vertex_counts)))


def test_shared_allocation_meets_the_tolerance_with_fewer_parameters():
    errors, vertex_counts = example_errors()
    counts = allocate_components(errors, vertex_counts, 0.06, parameters_per_component=65)
    separate_counts = [int(np.argmax(error_by_count <= 0.06)) for error_by_count in errors]
    assert common_error(errors, vertex_counts, counts) <= 0.06

    def count_parameters(counts: list[int]) -> int:
        return sum(count * (3 * vertex_count + 65) for count, vertex_count in zip(counts, vertex_counts, strict=True))

    assert count_parameters(counts) < count_parameters(separate_counts)
    assert all(error_by_count[count] <= 2 * 0.06 for error_by_count, count in zip(errors, counts, strict=True))


def test_an_unreachable_tolerance_takes_all_components():
    errors, vertices = [np.array([1.0, 0.5]), np.array([1.0])], [10, 10]
    assert allocate_components(errors, vertices, 1e-3, parameters_per_component=0) == [1, 0]


def test_a_truncated_basis_has_the_error_that_it_reports():
    values = random_residuals(60, 50, 12)
    basis = make_basis(values, 1e-5, np.random.default_rng(0))
    for count in range(len(basis.components) + 1):
        truncated = basis.truncate(count)
        error = rms(values - truncated.reconstruct(truncated.project(values)))
        assert truncated.truncation_rms == pytest.approx(error, rel=0.02, abs=1e-8)


@pytest.mark.parametrize("poses, vertices", [(60, 50), (200, 20)], ids=["gram", "covariance"])
def test_a_pose_of_weight_two_equals_two_poses(poses, vertices):
    values = random_residuals(poses, vertices, 12)
    repeated_values = np.concatenate([values, values[:10]])
    weights = np.where(np.arange(poses) < 10, 2.0, 1.0)
    weighted_basis, repeated_basis = (
        make_basis(values, 1e-5, np.random.default_rng(0), weights),
        make_basis(repeated_values, 1e-5, np.random.default_rng(0)),
    )
    np.testing.assert_allclose(weighted_basis.mean, repeated_basis.mean, atol=1e-8)
    np.testing.assert_allclose(weighted_basis.error_by_count, repeated_basis.error_by_count, rtol=1e-3, atol=1e-9)
    leading = slice(0, 5)
    np.testing.assert_allclose(
        np.abs(weighted_basis.components[leading] @ repeated_basis.components[leading].T), np.eye(5), atol=1e-3
    )


JOINTS = 4

INFLUENCING = {joint: tuple(j for j in (joint, joint + 1) if 0 < j < JOINTS) for joint in range(JOINTS)}


def with_heaviest_joints(rig: Rig) -> Rig:
    """Return the rig with each vertex on its heaviest joint."""
    is_heaviest = rig.skin_weights == rig.skin_weights.max(axis=1, keepdims=True)
    is_heaviest[:, 1] &= ~is_heaviest[:, 0]
    return replace(rig, skin_weights=is_heaviest.astype(np.float32))


@pytest.fixture(scope="module")
def smooth_rig() -> Rig:
    return chain_rig(JOINTS)


@pytest.fixture(scope="module")
def poses(smooth_rig) -> np.ndarray:
    """(320, J, 4, 4) pose matrices of the chain, far away from the origin."""
    translation = np.eye(4, dtype=np.float32)
    translation[:3, 3] = 7, -5, 3
    return translation @ pose_chain(smooth_rig, chain_angles(320, JOINTS, seed=4))


TRAINING = np.arange(300)


@pytest.mark.parametrize("joint", range(JOINTS))
def test_smooth_skinning_is_recovered(smooth_rig, poses, joint):
    """The true rig has smooth weights, and linear skinning has one joint per vertex. The fit explains all residuals."""
    rig = with_heaviest_joints(smooth_rig)
    partition = make_partitions(rig, INFLUENCING)[joint]
    skinning = LinearSkinning(rig)
    truth = LinearSkinning(smooth_rig).positions(poses)
    residuals = skinning.local_residuals(poses, truth)[:, partition.vertices]
    skin = skin_matrices(poses, rig.rest_matrices)
    fit, remainder = joint_regression(rig, partition, skin).fit(residuals, TRAINING)
    assert np.abs(residuals).max() > 5e-3 and np.abs(remainder).max() < 1e-4
    fitted = skinning.positions(poses)[:, partition.vertices] + fit.compute_offsets(skin)
    np.testing.assert_allclose(fitted, truth[:, partition.vertices], atol=1e-4)


def test_irrelevant_joints_are_removed(smooth_rig, poses):
    """All four joints are regressors, but the residual of the first partition depends on the second joint alone."""
    rig = with_heaviest_joints(smooth_rig)
    partition = make_partitions(rig, {0: (1, 2, 3)})[0]
    skin = skin_matrices(poses, rig.rest_matrices)
    residuals = LinearSkinning(rig).local_residuals(poses, LinearSkinning(smooth_rig).positions(poses))[
        :, partition.vertices
    ]
    noise = np.random.default_rng(1).normal(0, 1e-3, residuals.shape).astype(np.float32)
    regression = joint_regression(rig, partition, skin)
    assert regression.joints.tolist() == [0, 1, 2, 3]
    fit, remainder = regression.fit(residuals + noise, TRAINING)
    assert fit.joints.tolist() == [0, 1]
    assert np.abs(remainder - noise).max() < 1e-3 < np.abs(residuals).max() / 5


def drawn_residuals(rig: Rig, partition: Partition, count: int) -> np.ndarray:
    shape = (count, len(partition.vertices), 3)
    return np.random.default_rng(0).normal(0.01, 0.004, shape).astype(np.float32)


def test_offsets_and_remainder_sum_to_the_residuals(smooth_rig, poses):
    partition = make_partitions(smooth_rig, INFLUENCING)[1]
    skin = skin_matrices(poses, smooth_rig.rest_matrices)
    residuals = drawn_residuals(smooth_rig, partition, len(poses))
    fit, remainder = joint_regression(smooth_rig, partition, skin).fit(residuals, TRAINING)
    inverse = np.linalg.inv(skin[:, partition.joint, :3, :3].astype(np.float64))
    offsets = np.einsum("nab,nvb->nva", inverse, fit.compute_offsets(skin))
    np.testing.assert_allclose(offsets + remainder, residuals, atol=1e-5)
    assert (remainder[TRAINING] ** 2).mean() < 0.3 * (residuals[TRAINING] ** 2).mean(), "not even the mean was fitted"


def test_offsets_rotate_with_the_character(smooth_rig, poses):
    partition = make_partitions(smooth_rig, INFLUENCING)[1]
    skin = skin_matrices(poses, smooth_rig.rest_matrices)
    fit, _ = joint_regression(smooth_rig, partition, skin).fit(
        drawn_residuals(smooth_rig, partition, len(poses)), TRAINING
    )
    character_transform = rotation(1, 0.8)
    character_transform[:3, 3] = 3, 20, -1
    expected = fit.compute_offsets(skin) @ character_transform[:3, :3].T
    np.testing.assert_allclose(
        fit.compute_offsets((character_transform @ skin).astype(np.float32)), expected, atol=1e-4
    )


def test_the_fit_has_the_joints_that_only_influencing_joints_move():
    parents = (-1, 0, 1, 1, 3)
    rig = replace(chain_rig(5), joints=tuple(Joint(f"bone_{n}", parent) for n, parent in enumerate(parents)))
    skin = np.tile(np.eye(4, dtype=np.float32), (2, 5, 1, 1))

    def fitted_joints(joint: int, *influencing: int) -> list[int]:
        return joint_regression(rig, Partition(joint, influencing, np.arange(3)), skin).joints.tolist()

    assert fitted_joints(2, 2, 3) == [2, 1, 3]
    assert fitted_joints(2, 2, 4) == [2, 1], "joint 3 hides joint 4"
    assert fitted_joints(1, 1, 2, 3, 4) == [1, 0, 2, 3, 4]
    assert fitted_joints(0) == [0]


def test_the_main_joint_alone_fits_the_mean(smooth_rig, poses):
    partition = make_partitions(smooth_rig, INFLUENCING)[2]
    skin = skin_matrices(poses, smooth_rig.rest_matrices)
    residuals = drawn_residuals(smooth_rig, partition, len(poses))
    fit, remainder = joint_regression(smooth_rig, partition, skin).main_joint_only().fit(residuals, TRAINING)
    assert fit.joints.tolist() == [2]
    np.testing.assert_allclose(remainder, residuals - residuals[TRAINING].mean(axis=0), atol=1e-6)


def test_joints_that_never_moved_get_small_factors(smooth_rig):
    """No joint moves in the training poses, so all regressors are equal. A joint that moves later has little effect."""
    partition = make_partitions(smooth_rig, INFLUENCING)[1]
    still_poses = pose_chain(smooth_rig, np.zeros((30, JOINTS, 2)))
    skin = skin_matrices(still_poses, smooth_rig.rest_matrices)
    residuals = drawn_residuals(smooth_rig, partition, 30)
    fit, _ = joint_regression(smooth_rig, partition, skin).fit(residuals, np.arange(30))
    assert np.abs(fit.factors).max() < 0.1
    bent_skin = skin_matrices(pose_chain(smooth_rig, np.full((1, JOINTS, 2), 0.5)), smooth_rig.rest_matrices)
    assert np.abs(fit.compute_offsets(bent_skin)).max() < 0.1


def test_joints_that_move_alike_share_the_fit(smooth_rig):
    """In the training poses all joints bend in proportion, as with twist bones. Then a constraint of one is muted."""
    rig, proportions = with_heaviest_joints(smooth_rig), np.array([0, 1, 0.6, 0.3])
    angles = np.random.default_rng(0).uniform(0, 1.9, (300, 1, 1)) * proportions[:, None] * [1, 0]
    training_poses = pose_chain(smooth_rig, angles)
    muted_poses = pose_chain(smooth_rig, np.array([[0, 0], [1.2, 0], [0, 0], [0.36, 0]])[None])
    partition = make_partitions(rig, {1: (1, 2, 3)})[1]
    skin = skin_matrices(training_poses, rig.rest_matrices)
    # What smoothing does is not linear in the transforms.
    residuals = np.sin(angles[:, 1:2, :1]) ** 2 * drawn_residuals(rig, partition, 1)
    fit, remainder = joint_regression(rig, partition, skin).fit(residuals.astype(np.float32), TRAINING)
    assert np.sqrt((remainder**2).mean()) < 0.4 * np.sqrt((residuals**2).mean())
    offsets = fit.compute_offsets(skin_matrices(muted_poses, rig.rest_matrices))
    assert np.abs(offsets).max() < 2 * np.abs(residuals).max()


POSES, KEYS = 150, 8


def key_motions(vertex_count: int) -> np.ndarray:
    """Return (3 KEYS, V) motions: half of the keys move the odd vertices, the others the even ones."""
    motions = np.random.default_rng(0).normal(0, 0.01, (KEYS, 3, vertex_count))
    motions[: KEYS // 2, :, ::2] = 0
    motions[KEYS // 2 :, :, 1::2] = 0
    return motions.reshape(3 * KEYS, vertex_count).astype(np.float32)


@pytest.mark.parametrize("vertex_count", [200, 4000])
def test_vertices_with_different_keys_are_divided_if_they_are_many(vertex_count):
    factors = np.zeros((4, vertex_count), np.float32)
    fit = JointFit(np.zeros(1, np.int64), factors, np.arange(KEYS), key_motions(vertex_count))
    groups = divide_partition(fit, np.full(KEYS, 0.3), 4e-5)
    if vertex_count == 200:
        assert [group.tolist() for group in groups] == [list(range(200))]
    else:
        assert sorted(group[:3].tolist() for group in groups) == [[0, 2, 4], [1, 3, 5]]


@pytest.mark.parametrize(
    "counts, min_vertices, expected", [((4, 5), 4, [4, 5]), ((4, 5), 5, [9]), ((2, 3, 2, 4), 3, [3, 8])]
)
def test_partitions_are_divided_by_mesh_where_each_mesh_has_enough_vertices(counts, min_vertices, expected):
    rig = chain_rig(vertex_count=100 + sum(counts))
    rig = replace(rig, meshes=tuple(replace(rig.meshes[0], vertices=count) for count in (100, *counts)))
    partition = Partition(0, (), np.arange(100, 100 + sum(counts), dtype=np.int32))
    divided = sorted(divide_by_mesh(rig, [partition], min_vertices), key=lambda part: len(part.vertices))
    assert [len(part.vertices) for part in divided] == expected
    assert np.array_equal(np.sort(np.concatenate([part.vertices for part in divided])), partition.vertices)
    assert all((np.diff(part.vertices) > 0).all() for part in divided)
    if len(expected) == len(counts):
        assert [mesh_of(rig, part) for part in divided] == [1, 2]


@pytest.fixture
def divided(tmp_path, monkeypatch) -> Path:
    """Return a folder with a recording, and a model that divides its partitions."""
    monkeypatch.setattr(preparation, "MIN_DIVIDED_VERTICES", 50)
    monkeypatch.setattr(parts, "PART_PARAMETERS", 100)
    keys = tuple(Control("shape_keys", f'key_blocks["{index}"].value', 0, 1) for index in range(KEYS))
    rig = replace(chain_rig(vertex_count=300), controls=keys)
    values = np.random.default_rng(1).uniform(0, 1, (POSES, KEYS)).astype(np.float32)
    poses = pose_chain(rig, chain_angles(POSES, 3, 0))
    residuals = (values @ key_motions(300).reshape(KEYS, -1)).reshape(POSES, 3, 300).transpose(0, 2, 1).copy()
    # The product of the first two keys is not linear.
    residuals[:, 1::2, 0] += 0.01 * values[:, :1] * values[:, 1:2]
    influences = {0: (), 1: (1,), 2: (2,)}, {joint: tuple(range(KEYS)) for joint in range(3)}
    arrays = poses, residuals, values
    write_recording(tmp_path / "recording", rig, make_partitions(rig, *influences), chain_info(POSES), *arrays)
    assert main([str(tmp_path / "recording"), str(tmp_path / "model.onnx"), *QUICK_OPTIONS]) == 0
    np.savez(tmp_path / "truth", poses=poses, values=values, residuals=residuals)
    return tmp_path


def test_a_divided_partition_is_one_partition_of_the_model(divided):
    report = json.loads((divided / "report.json").read_text())
    assert [p["parts"] for p in report["partitions"]] == [2, 2, 2]
    assert len(read_model_info(divided / "model.onnx").partitions) == 3
    network, truth = Network(divided / "model.onnx"), np.load(divided / "truth.npz")
    rig = chain_rig(vertex_count=300)
    expected = LinearSkinning(rig, make_partitions(rig)).complex_positions(truth["poses"], truth["residuals"])
    errors = np.linalg.norm(network.positions(truth["poses"], truth["values"]) - expected, axis=2)
    assert errors.mean() < 3e-4 and report["fdda"]["held_out"]["mean"] < 0.3
    assert network.confidence(truth["poses"], truth["values"]).shape == (POSES, 3)


def test_a_warm_start_keeps_the_parts(divided, monkeypatch):
    before = json.loads((divided / "report.json").read_text())
    monkeypatch.setattr(parts, "PART_PARAMETERS", 1e9)
    options = (*QUICK_OPTIONS, "--passes", "10", "--warm-start")
    assert main([str(divided / "recording"), str(divided / "model.onnx"), *options]) == 0
    after = json.loads((divided / "report.json").read_text())
    assert [p["parts"] for p in after["partitions"]] == [2, 2, 2]
    assert after["fdda"]["held_out"]["mean"] < 1.5 * before["fdda"]["held_out"]["mean"]
