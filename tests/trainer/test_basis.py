# SPDX-License-Identifier: GPL-3.0-or-later
"""The tolerance determines the number of components, both with the Gram matrix and with the covariance matrix."""

import numpy as np
import pytest

from trainer.fits import basis as basis_module
from trainer.fits.basis import allocate_components, make_basis


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
