# SPDX-License-Identifier: GPL-3.0-or-later
"""Low-rank factors of large partitions have fewer parameters and give the same positions, anywhere and in any unit."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.formats.model import POSE_INPUT
from fdda_addon.core.formats.onnx_file import infer_shapes, read_onnx
from fdda_addon.core.mathematics.partition import Partition, make_partitions
from fdda_addon.core.mathematics.skinning import LinearSkinning, skin_matrices
from fdda_addon.core.rig import Rig
from trainer.export.export import build_graph
from trainer.fits import low_rank
from trainer.fits.basis import make_basis
from trainer.fits.joint_fit import JointFit, JointRegression, joint_regression
from trainer.fits.low_rank import TOLERANCE_RATIO, LowRankFactors, may_factorize
from trainer.model import TrainedModel

from ..recordings import write_recording
from .chain import chain_angles, chain_info, chain_rig, pose_chain
from .conftest import train_model
from .test_graph import check_agreement, run_graph

JOINTS, VERTICES, POSES = 3, 6_000, 120
INFLUENCING = {0: (1,), 1: (1, 2), 2: (2,)}
TOLERANCE = 4e-5
TRAINING = np.arange(POSES)
ONES = np.ones(POSES)


def sliding_residuals(rig: Rig, angles: np.ndarray) -> np.ndarray:
    """Return (N, V, 3) float32 local residuals: bulges that slide with the bends and so need many components."""
    joint_coordinate = rig.rest_positions[:, 2] * JOINTS
    residuals = np.zeros((len(angles), rig.vertex_count, 3))
    for joint in range(1, JOINTS):
        bend, twist = angles[:, joint, :1], angles[:, joint, 1:]
        bulge = np.exp(-(((joint_coordinate - joint - 0.5 * bend) / 0.3) ** 2)) * 0.02
        residuals[:, :, 0] += bulge * bend**2
        residuals[:, :, 1] += bulge * np.sin(twist) * np.cos(7 * joint_coordinate + twist)
    return residuals.astype(np.float32)


class PreparedTube:
    """A partition of the chain's tube with its fit and basis.

    Args:
        origin_distance: distance of the tube from the origin, meters.
        units_per_metre: mesh units per meter.
        without_residuals: whether all residuals are 0.
    """

    def __init__(self, origin_distance: float = 0.0, units_per_metre: float = 1.0, without_residuals: bool = False):
        rig, angles = chain_rig(JOINTS, VERTICES), chain_angles(POSES, JOINTS, 0)
        residuals = sliding_residuals(rig, angles) * (not without_residuals)
        translation = np.eye(4)
        translation[:3, 3] = origin_distance
        self.rig, poses = move_rig(rig, translation, units_per_metre), translation @ pose_chain(rig, angles)
        poses[..., :3, 3] *= units_per_metre
        self.partition: Partition = make_partitions(self.rig, INFLUENCING)[1]
        self.skin = skin_matrices(poses, self.rig.rest_matrices)
        self.regression: JointRegression = joint_regression(self.rig, self.partition, self.skin)
        partition_residuals = residuals[:, self.partition.vertices] * np.float32(units_per_metre)
        self.tolerance = TOLERANCE * units_per_metre
        self.fit, remainder = self.regression.fit(partition_residuals, TRAINING)
        remainder = remainder.reshape(POSES, -1)
        self.basis = make_basis(remainder, self.tolerance, np.random.default_rng(0))
        self.coefficients = self.basis.project(remainder)

    def factorize(self, weights: np.ndarray = ONES) -> LowRankFactors | None:
        arguments = self.fit, self.basis, self.coefficients, self.regression, TRAINING, weights, self.tolerance
        return low_rank.factorize(*arguments)

    def offsets(self, source: "PreparedTube | LowRankFactors") -> np.ndarray:
        """Return the (N, Vp, 3) offsets from linear skinning in the space of the main joint, mesh units."""
        coefficients = self.coefficients
        if isinstance(source, LowRankFactors):
            coefficients = (coefficients @ source.change_of_basis.T).astype(np.float32)
        to_local = np.linalg.inv(self.skin[:, self.partition.joint, :3, :3].astype(np.float64))
        fitted = source.fit.compute_offsets(self.skin) @ to_local.transpose(0, 2, 1)
        return fitted + source.basis.reconstruct(coefficients).reshape(fitted.shape)


def move_rig(rig: Rig, translation: np.ndarray, units_per_metre: float) -> Rig:
    rest_matrices = translation @ rig.rest_matrices
    rest_matrices[:, :3, 3] *= units_per_metre
    positions = (rig.rest_positions + translation[:3, 3]) * units_per_metre
    return replace(
        rig,
        rest_positions=positions.astype(np.float32),
        rest_matrices=rest_matrices.astype(np.float32),
        metres_per_unit=1 / units_per_metre,
    )


@pytest.fixture(scope="module")
def prepared() -> PreparedTube:
    return PreparedTube()


def rms(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).sum(axis=2).mean()))


@pytest.mark.parametrize("origin_distance, units_per_metre", [(0, 1), (100, 1), (0, 1000), (100, 1000)])
def test_factors_give_the_same_offsets_with_fewer_parameters(origin_distance, units_per_metre):
    prepared = PreparedTube(origin_distance, units_per_metre)
    factors = prepared.factorize()
    row_count = len(prepared.fit.factors) + 3 * len(prepared.basis.components)
    # The rank does not depend on position and unit.
    assert len(factors.vertex_factors) == len(PreparedTube().factorize().vertex_factors) < row_count / 2
    error = rms(prepared.offsets(factors) - prepared.offsets(prepared)) / units_per_metre
    # Rounding to float32 100 m away is larger than the error of the factors.
    assert 0 < error < TOLERANCE_RATIO * TOLERANCE + origin_distance * 2e-7
    assert factors.error_rms / units_per_metre <= TOLERANCE_RATIO * TOLERANCE
    if not origin_distance:
        assert error == pytest.approx(factors.error_rms / units_per_metre, rel=0.02)


def test_fit_and_basis_are_in_the_span_of_the_factors(prepared):
    factors = prepared.factorize()
    count, vertices = len(factors.basis.components), len(prepared.partition.vertices)
    np.testing.assert_allclose(
        factors.vertex_factors @ factors.vertex_factors.T, np.eye(len(factors.vertex_factors)), atol=1e-5
    )
    np.testing.assert_allclose(factors.basis.components @ factors.basis.components.T, np.eye(count), atol=1e-5)
    for parameters in (
        factors.fit.factors,
        factors.basis.mean.reshape(vertices, 3).T,
        *factors.basis.components.reshape(count, vertices, 3).transpose(0, 2, 1),
    ):
        np.testing.assert_allclose(
            parameters @ factors.vertex_factors.T @ factors.vertex_factors,
            parameters,
            atol=1e-5 * np.abs(parameters).max(),
        )
    # A common motion of all joints still moves nothing.
    np.testing.assert_allclose(factors.fit.factors.reshape(-1, 4, vertices)[:, 3].sum(axis=0), 0, atol=1e-6)


def test_the_basis_has_the_error_of_the_factors(prepared):
    factors = prepared.factorize()
    assert factors.basis.truncation_rms == pytest.approx(np.hypot(prepared.basis.truncation_rms, factors.error_rms))
    assert len(factors.basis.error_by_count) == len(factors.basis.components) + 1


def test_a_lower_pose_weight_lowers_the_rank(prepared):
    weights = np.where(TRAINING < 2, 1.0, 1e-9)
    assert len(prepared.factorize(weights).vertex_factors) < len(prepared.factorize().vertex_factors)


def test_zero_residuals_have_rank_zero():
    without_residuals = PreparedTube(without_residuals=True)
    # The fit has more joints than the residuals need.
    factors = np.zeros((12, len(without_residuals.partition.vertices)), np.float32)
    without_residuals.fit = JointFit(np.arange(3)[[1, 0, 2]], factors)
    factors = without_residuals.factorize()
    assert (
        factors.vertex_factors.shape == (0, len(without_residuals.partition.vertices))
        and len(factors.basis.components) == 0
    )
    assert not without_residuals.offsets(factors).any() and factors.change_of_basis.shape[0] == 0


def test_small_partitions_are_not_factorized(prepared):
    few_vertices = slice(0, 100)
    fit = replace(prepared.fit, factors=prepared.fit.factors[:, few_vertices])
    basis = replace(prepared.basis, mean=prepared.basis.mean[:300], components=prepared.basis.components[:, :300])
    assert may_factorize(prepared.fit, prepared.basis)
    assert not may_factorize(fit, basis)
    # A fit without joints is not factorized.
    assert not may_factorize(JointFit(np.zeros(0, np.int64), prepared.fit.factors[:0]), prepared.basis)


def test_independent_parameters_are_not_factorized(prepared):
    rng = np.random.default_rng(0)
    random_tube = PreparedTube()
    random_tube.fit = replace(
        random_tube.fit, factors=rng.normal(0, 0.1, random_tube.fit.factors.shape).astype(np.float32)
    )
    count = len(random_tube.basis.components)
    orthonormal_columns = np.linalg.qr(rng.normal(0, 1, (3 * len(random_tube.partition.vertices), count)))[0]
    random_tube.basis = replace(random_tube.basis, components=orthonormal_columns.T.astype(np.float32))
    random_tube.coefficients = rng.normal(0, 1, random_tube.coefficients.shape).astype(np.float32)
    assert random_tube.factorize() is None


@pytest.fixture(scope="module")
def trained_model(tmp_path_factory) -> TrainedModel:
    rig, angles = chain_rig(JOINTS, VERTICES), chain_angles(POSES, JOINTS, 0)
    path = tmp_path_factory.mktemp("low_rank")
    write_recording(
        path / "recording",
        rig,
        make_partitions(rig, INFLUENCING),
        chain_info(POSES),
        pose_chain(rig, angles),
        sliding_residuals(rig, angles),
    )
    return train_model(path / "recording", path / "model.onnx")


def test_the_graph_agrees_with_pytorch(trained_model):
    assert all(partition.vertex_factors is not None for partition in trained_model.prepared)
    contents = read_onnx(build_graph(trained_model).SerializeToString())
    sizes = infer_shapes(contents, {POSE_INPUT: (1, len(trained_model.rig.joints), 4, 4)}, 1)
    factorized = [index for index in range(JOINTS) if f"left_factor_{index}" in sizes]
    assert factorized == list(range(JOINTS))
    for index in factorized:
        rows, columns = sizes[f"left_factor_{index}"]
        assert sizes[f"matrix_{index}"][0] == columns < rows
    assert (
        check_agreement(trained_model, pose_chain(trained_model.rig, chain_angles(20, JOINTS, 5) * [1, 0])) > 0
    ).all()


def test_the_graph_agrees_far_away_and_beyond_the_range(trained_model):
    poses = pose_chain(trained_model.rig, chain_angles(20, JOINTS, 5, range_scale=1.2))
    translation = np.eye(4)
    translation[:3, 3] = 60, -70, 40
    confidence = check_agreement(trained_model, (translation @ poses).astype(np.float32), tolerance=1e-4)
    assert (confidence < 1).any()
    torn = pose_chain(trained_model.rig, chain_angles(1, JOINTS, 5))
    torn[:, 2, :3, 3] += 3 * trained_model.rig.size
    positions, confidence = run_graph(trained_model, torn)
    middle = trained_model.partitions[1].vertices
    assert confidence[0, 1] == 0
    linear = LinearSkinning(trained_model.rig).positions(torn)
    np.testing.assert_allclose(positions[:, middle], linear[:, middle], atol=1e-6)
