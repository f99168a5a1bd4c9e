# SPDX-License-Identifier: GPL-3.0-or-later
"""Basis shapes: their number follows from the tolerance, by either way to the components."""

import numpy as np
import pytest

from trainer import basis as basis_module
from trainer.basis import make_basis, share_shapes


def residuals(poses: int, vertices: int, rank: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    sizes = 0.01 * 0.5 ** np.arange(rank)
    shapes = np.linalg.qr(rng.normal(size=(3 * vertices, rank)))[0].T
    return (rng.normal(size=(poses, rank)) * sizes @ shapes + rng.normal(size=3 * vertices) * 0.01).astype(np.float32)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values.astype(np.float64) ** 2).sum() * 3 / values.size))


@pytest.mark.parametrize("poses, vertices", [(60, 50), (200, 20)], ids=["gram", "covariance"])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-5, 1e-6])
def test_as_few_shapes_as_the_tolerance_allows(poses, vertices, tolerance, monkeypatch):
    monkeypatch.setattr(basis_module, "NEGLIGIBLE", 0)
    values = residuals(poses, vertices, 12)
    basis = make_basis(values, tolerance, np.random.default_rng(0))
    left = rms(values - basis.residuals(basis.coefficients(values)))
    assert left <= tolerance * 1.01
    assert basis.truncation == pytest.approx(left, rel=0.02, abs=1e-8)
    coefficients = basis.coefficients(values)[:, :-1]
    fewer = coefficients @ basis.shapes[:-1] + basis.mean
    assert rms(values - fewer) > tolerance
    assert 0 < len(basis.shapes) <= 12


def test_no_shapes_for_less_than_a_hundredth_of_the_residual():
    values = residuals(60, 50, 12)
    basis = make_basis(values, 1e-9, np.random.default_rng(0))
    spread = rms(values - values.mean(axis=0))
    assert 0.002 * spread < basis.truncation <= 0.01 * spread
    assert len(basis.shapes) < 12


def test_shapes_are_orthonormal_so_coefficients_measure_distance():
    values = residuals(80, 100, 10)
    basis = make_basis(values, 1e-6, np.random.default_rng(0))
    np.testing.assert_allclose(basis.shapes @ basis.shapes.T, np.eye(len(basis.shapes)), atol=1e-5)
    coefficients = basis.coefficients(values)
    apart = np.linalg.norm(values[3].astype(np.float64) - values[4])
    assert np.linalg.norm(coefficients[3] - coefficients[4]) == pytest.approx(apart, rel=1e-3)


def test_a_constant_residual_needs_no_shape():
    values = np.tile(np.float32([[0.01, 0.02, 0.03]]), (20, 5))
    basis = make_basis(values, 1e-5, np.random.default_rng(0))
    assert basis.shapes.shape == (0, 15)
    np.testing.assert_allclose(basis.residuals(basis.coefficients(values)), values, atol=1e-8)


def test_a_sample_of_the_poses_finds_the_same_shapes(monkeypatch):
    monkeypatch.setattr(basis_module, "MAX_POSES", 50)
    monkeypatch.setattr(basis_module, "NEGLIGIBLE", 0)
    values = residuals(150, 60, 6)
    basis = make_basis(values, 1e-6, np.random.default_rng(0))
    assert rms(values - basis.residuals(basis.coefficients(values))) < 3e-6


def spectra() -> tuple[list[np.ndarray], list[int]]:
    """What is left of three partitions by number of shapes: a simple one, one that goes on and on, a small one."""
    return [np.array(own) for own in ([1.0, 0.1, 0.02, 0.005], 0.8 ** np.arange(25), [0.5, 0.1, 0.05])], [400, 40, 10]


def left_together(left: list[np.ndarray], vertices: list[int], counts: list[int]) -> float:
    squared = sum(size * own[count] ** 2 for own, size, count in zip(left, vertices, counts, strict=True))
    return float(np.sqrt(squared / sum(vertices)))


def test_partitions_share_shapes_to_keep_the_tolerance_with_less_to_read():
    left, vertices = spectra()
    counts = share_shapes(left, vertices, 0.06, units=65)
    alone = [int(np.argmax(own <= 0.06)) for own in left]
    assert left_together(left, vertices, counts) <= 0.06

    def numbers(shapes: list[int]) -> int:
        return sum(count * (3 * size + 65) for count, size in zip(shapes, vertices, strict=True))

    assert numbers(counts) < numbers(alone)
    assert all(own[count] <= 2 * 0.06 for own, count in zip(left, counts, strict=True))


def test_one_partition_shares_with_nobody():
    left, vertices = spectra()
    for own, size in zip(left, vertices, strict=True):
        (count,) = share_shapes([own], [size], 0.06, units=65)
        assert own[count] <= 0.06 < own[count - 1]


def test_where_the_tolerance_cannot_be_kept_all_shapes_are_taken():
    left, vertices = [np.array([1.0, 0.5]), np.array([1.0])], [10, 10]
    assert share_shapes(left, vertices, 1e-3, units=0) == [1, 0]


def test_the_first_shapes_of_a_basis_leave_what_it_says():
    values = residuals(60, 50, 12)
    basis = make_basis(values, 1e-5, np.random.default_rng(0))
    for count in range(len(basis.shapes) + 1):
        fewer = basis.first(count)
        left = rms(values - fewer.residuals(fewer.coefficients(values)))
        assert fewer.truncation == pytest.approx(left, rel=0.02, abs=1e-8)


@pytest.mark.parametrize("poses, vertices", [(60, 50), (200, 20)], ids=["gram", "covariance"])
def test_a_pose_that_counts_twice_is_as_good_as_two(poses, vertices):
    values = residuals(poses, vertices, 12)
    twice = np.concatenate([values, values[:10]])
    weights = np.where(np.arange(poses) < 10, 2.0, 1.0)
    weighted, repeated = (
        make_basis(values, 1e-5, np.random.default_rng(0), weights),
        make_basis(twice, 1e-5, np.random.default_rng(0)),
    )
    np.testing.assert_allclose(weighted.mean, repeated.mean, atol=1e-8)
    np.testing.assert_allclose(weighted.left, repeated.left, rtol=1e-3, atol=1e-9)
    first = slice(0, 5)
    np.testing.assert_allclose(np.abs(weighted.shapes[first] @ repeated.shapes[first].T), np.eye(5), atol=1e-3)
