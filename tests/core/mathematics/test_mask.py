# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks: each vertex is blended between linear skinning and the model by its weight."""

import numpy as np
import pytest

from fdda_addon.core.mathematics.mask import Mask, SkinningBlend
from fdda_addon.core.mathematics.skinning import LinearSkinning

from ..limb import VERTEX_COUNT, make_rig, random_poses

MASK_WEIGHTS = np.linspace(0, 1, VERTEX_COUNT).astype(np.float32)


@pytest.fixture(scope="module")
def rig():
    """The rig of the limb."""
    return make_rig()


@pytest.fixture
def positions() -> np.ndarray:
    """Positions of a model's output in five poses."""
    return np.random.default_rng(3).uniform(-1, 1, (5, VERTEX_COUNT, 3)).astype(np.float32)


@pytest.mark.parametrize(
    "weights", [None, MASK_WEIGHTS, np.zeros(VERTEX_COUNT), np.ones(VERTEX_COUNT), (MASK_WEIGHTS > 0.5) * 1.0]
)
@pytest.mark.parametrize("strengths", [[1, 1, 1, 1, 1], [0, 0, 0, 0, 0], [0, 0.25, 0.5, 1, 1]])
def test_positions_are_blended_by_strength_times_weight(rig, positions, weights, strengths):
    poses, strengths = random_poses(5), np.float32(strengths)
    linear_positions = LinearSkinning(rig).positions(poses)
    vertex_weights = np.ones(VERTEX_COUNT) if weights is None else weights
    expected = linear_positions + (strengths[:, None] * vertex_weights)[..., None] * (positions - linear_positions)
    blend = SkinningBlend(rig, None if weights is None else Mask.from_weights(weights))
    blended = blend.apply(positions.copy(), poses, strengths)
    np.testing.assert_allclose(blended, expected, atol=1e-6)
    assert blended.dtype == np.float32
    if weights is not None and strengths.min() == 1:
        np.testing.assert_allclose(
            Mask.from_weights(weights).blend(linear_positions[0], positions[0]), expected[0], atol=1e-6
        )


def test_vertices_with_weight_one_keep_the_model_s_positions(rig, positions):
    weights = (np.arange(VERTEX_COUNT) % 2).astype(np.float32)
    blended = SkinningBlend(rig, Mask.from_weights(weights)).apply(
        positions.copy(), random_poses(5), np.ones(5, np.float32)
    )
    assert (blended[:, 1::2] == positions[:, 1::2]).all() and (blended[:, ::2] != positions[:, ::2]).any()


def test_positions_with_strength_zero_may_be_invalid(rig, positions):
    """With strength 0 the model does not run, so its output buffer may contain any values."""
    positions[0] = np.nan
    assert np.isfinite(SkinningBlend(rig).apply(positions, random_poses(5), np.float32([0, 1, 0.5, 1, 1]))).all()


def test_with_mask_replaces_the_mask(rig, positions):
    poses, full_strengths = random_poses(5), np.ones(5, np.float32)
    blend = SkinningBlend(rig, Mask.from_weights(MASK_WEIGHTS))
    blend.apply(positions.copy(), poses, full_strengths)
    replaced = blend.with_mask(Mask.from_weights(1 - MASK_WEIGHTS))
    expected = SkinningBlend(rig, Mask.from_weights(1 - MASK_WEIGHTS)).apply(positions.copy(), poses, full_strengths)
    assert (replaced.apply(positions.copy(), poses, full_strengths) == expected).all()
    assert (blend.with_mask(None).apply(positions.copy(), poses, full_strengths) == positions).all()


def test_weights_are_clamped_to_zero_and_one():
    mask = Mask.from_weights([-1, 0.5, 3])
    assert mask.weights.tolist() == [0, 0.5, 1] and mask.partial_vertices.tolist() == [0, 1]
    assert mask == Mask.from_weights([0, 0.5, 1]) and mask != Mask.from_weights([0, 0.5, 0.5])
