# SPDX-License-Identifier: GPL-3.0-or-later
"""Rotation vectors and Euler angles of many quaternions: the same rotations, in ranges that do not wrap."""

import numpy as np
import pytest

from fdda_addon.core.rotations import euler_angles, rotation_vectors, total_range_width


def about(axis: int, angles: np.ndarray) -> np.ndarray:
    """(F, 4) quaternions about one axis; every other one has the other sign."""
    quaternions = np.zeros((len(angles), 4))
    quaternions[:, 0], quaternions[:, 1 + axis] = np.cos(angles / 2), np.sin(angles / 2)
    quaternions[::2] *= -1
    return quaternions


def product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    w, v, x, u = first[:, :1], first[:, 1:], second[:, :1], second[:, 1:]
    scalar = w * x - (v * u).sum(axis=1, keepdims=True)
    return np.hstack([scalar, w * u + x * v + np.cross(v, u)])


def from_vectors(vectors: np.ndarray) -> np.ndarray:
    angles = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.hstack([np.cos(angles / 2), vectors * np.sinc(angles / 2 / np.pi) / 2])


def from_angles(angles: np.ndarray) -> np.ndarray:
    x, y, z = (about(axis, angles[:, axis]) for axis in range(3))
    return product(z, product(y, x))


def random_quaternions() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((500, 4))


def locked_quaternions() -> np.ndarray:
    angles = np.random.default_rng(1).uniform(-3, 3, (100, 3))
    angles[:, 1] = np.where(angles[:, 1] > 0, np.pi / 2, -np.pi / 2)
    return from_angles(angles)


@pytest.mark.parametrize("quaternions", [random_quaternions(), locked_quaternions(), about(0, np.linspace(-9, 9, 50))])
@pytest.mark.parametrize("compute, compose", [(rotation_vectors, from_vectors), (euler_angles, from_angles)])
def test_the_numbers_are_of_the_same_rotations(quaternions, compute, compose):
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((compose(compute(quaternions)) * unit).sum(axis=1)), 1, atol=1e-12)


@pytest.mark.parametrize("compute", [rotation_vectors, euler_angles])
@pytest.mark.parametrize("low, high", [(-1, 1), (0, 4.5), (2.5, 4), (-4, -3)])
@pytest.mark.parametrize("axis", [0, 2])
def test_a_range_about_one_axis_is_as_wide_as_the_motion(compute, low, high, axis):
    values = compute(about(axis, np.linspace(low, high, 40)))
    assert total_range_width(values) == pytest.approx(high - low)


def test_a_quaternion_without_length_does_not_rotate():
    zeros = np.zeros((2, 4))
    assert not rotation_vectors(zeros).any() and not euler_angles(zeros).any()
