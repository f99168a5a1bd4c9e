# SPDX-License-Identifier: GPL-3.0-or-later
"""Joint matrices that are not finite are replaced, and nothing else of the pose changes, also far from the origin."""

import numpy as np
import pytest

from fdda_addon.core.formats.pose_repair import repair_pose

from ..limb import random_transforms
from ..tiny_model import JOINT_COUNT, tiny_info

DISTANCE = 1000.0
"""Distance of the character from the origin, mesh units."""


@pytest.fixture
def info():
    rest_matrices = random_transforms(np.random.default_rng(1), JOINT_COUNT).astype(np.float32)
    rest_matrices[:, :3, 3] += DISTANCE
    return tiny_info(rest_matrices=rest_matrices)


@pytest.fixture
def pose():
    pose = random_transforms(np.random.default_rng(2), JOINT_COUNT).astype(np.float32)
    pose[:, :3, 3] += DISTANCE
    return pose


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_joint_moves_with_its_parent(info, pose, value):
    broken = pose.copy()
    broken[1:, 0, 0] = value
    repaired, name = repair_pose(broken, info)
    assert name == "upper.L" and repaired.dtype == np.float32
    assert np.array_equal(repaired[0], pose[0])
    rest = info.rest_matrices.astype(np.float64)
    expected = pose[0].astype(np.float64) @ np.linalg.inv(rest[0]) @ rest[1:]
    assert np.abs(repaired[1:] - expected).max() < 2 * np.spacing(np.float32(np.abs(expected).max()))


def test_a_joint_without_parent_rests(info, pose):
    broken = pose.copy()
    broken[0, 2, 3] = np.nan
    repaired, name = repair_pose(broken, info)
    assert name == "root"
    assert np.array_equal(repaired, np.concatenate((info.rest_matrices[:1], pose[1:])))
