# SPDX-License-Identifier: GPL-3.0-or-later
"""Rotation vectors and Euler angles of many quaternions: they represent the same rotations, without jumps of 360°."""

import numpy as np
import pytest

from fdda_addon.core.mathematics.rotations import euler_angles, rotation_vectors, total_range_width


def axis_quaternions(axis: int, angles: np.ndarray) -> np.ndarray:
    """Return (F, 4) quaternions of rotations about one axis; every second quaternion is negated."""
    quaternions = np.zeros((len(angles), 4))
    quaternions[:, 0], quaternions[:, 1 + axis] = np.cos(angles / 2), np.sin(angles / 2)
    quaternions[::2] *= -1
    return quaternions


def quaternion_products(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Multiply (F, 4) quaternions; the second rotation is applied first."""
    w, v, x, u = left[:, :1], left[:, 1:], right[:, :1], right[:, 1:]
    scalar = w * x - (v * u).sum(axis=1, keepdims=True)
    return np.hstack([scalar, w * u + x * v + np.cross(v, u)])


def quaternions_from_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return the (F, 4) quaternions of (F, 3) rotation vectors."""
    angles = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.hstack([np.cos(angles / 2), vectors * np.sinc(angles / 2 / np.pi) / 2])


def quaternions_from_angles(angles: np.ndarray) -> np.ndarray:
    """Return the (F, 4) quaternions of (F, 3) Euler angles in the order XYZ."""
    x, y, z = (axis_quaternions(axis, angles[:, axis]) for axis in range(3))
    return quaternion_products(z, quaternion_products(y, x))


def random_quaternions() -> np.ndarray:
    """Return (500, 4) random quaternions that are not normalized."""
    return np.random.default_rng(0).standard_normal((500, 4))


def gimbal_lock_quaternions() -> np.ndarray:
    """Return quaternions whose Euler angle about Y is plus or minus 90 degrees."""
    angles = np.random.default_rng(1).uniform(-3, 3, (100, 3))
    angles[:, 1] = np.where(angles[:, 1] > 0, np.pi / 2, -np.pi / 2)
    return quaternions_from_angles(angles)


@pytest.mark.parametrize(
    "quaternions", [random_quaternions(), gimbal_lock_quaternions(), axis_quaternions(0, np.linspace(-9, 9, 50))]
)
@pytest.mark.parametrize(
    "compute, compose", [(rotation_vectors, quaternions_from_vectors), (euler_angles, quaternions_from_angles)]
)
def test_angles_represent_the_rotations_of_the_quaternions(quaternions, compute, compose):
    unit_quaternions = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((compose(compute(quaternions)) * unit_quaternions).sum(axis=1)), 1, atol=1e-12)


@pytest.mark.parametrize("compute", [rotation_vectors, euler_angles])
@pytest.mark.parametrize("low, high", [(-1, 1), (0, 4.5), (2.5, 4), (-4, -3)])
@pytest.mark.parametrize("axis", [0, 2])
def test_a_range_about_one_axis_has_the_width_of_the_motion(compute, low, high, axis):
    values = compute(axis_quaternions(axis, np.linspace(low, high, 40)))
    assert total_range_width(values) == pytest.approx(high - low)


def test_a_quaternion_without_length_does_not_rotate():
    zeros = np.zeros((2, 4))
    assert not rotation_vectors(zeros).any() and not euler_angles(zeros).any()
