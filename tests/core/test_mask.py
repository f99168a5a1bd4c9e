# SPDX-License-Identifier: GPL-3.0-or-later
"""Masks: where a model counts, and what is shown elsewhere."""

import numpy as np
import pytest

from fdda_addon.core.mask import Mask, SkinningBlend
from fdda_addon.core.skinning import LinearSkinning

from .limb import VERTICES, make_rig, random_poses

WEIGHTS = np.linspace(0, 1, VERTICES).astype(np.float32)


@pytest.fixture(scope="module")
def rig():
    return make_rig()


@pytest.fixture
def positions() -> np.ndarray:
    return np.random.default_rng(3).uniform(-1, 1, (5, VERTICES, 3)).astype(np.float32)


@pytest.mark.parametrize("weights", [None, WEIGHTS, np.zeros(VERTICES), np.ones(VERTICES), (WEIGHTS > 0.5) * 1.0])
@pytest.mark.parametrize("strengths", [[1, 1, 1, 1, 1], [0, 0, 0, 0, 0], [0, 0.25, 0.5, 1, 1]])
def test_a_blend_is_what_strength_times_weight_says(rig, positions, weights, strengths):
    poses, strengths = random_poses(5), np.float32(strengths)
    linear = LinearSkinning(rig).positions(poses)
    each = np.ones(VERTICES) if weights is None else weights
    expected = linear + (strengths[:, None] * each)[..., None] * (positions - linear)
    blend = SkinningBlend(rig, None if weights is None else Mask.from_weights(weights))
    shown = blend.apply(positions.copy(), poses, strengths)
    np.testing.assert_allclose(shown, expected, atol=1e-6)
    assert shown.dtype == np.float32
    if weights is not None and strengths.min() == 1:
        np.testing.assert_allclose(Mask.from_weights(weights).blend(linear[0], positions[0]), expected[0], atol=1e-6)


def test_where_a_mask_is_one_the_model_is_untouched(rig, positions):
    weights = (np.arange(VERTICES) % 2).astype(np.float32)
    shown = SkinningBlend(rig, Mask.from_weights(weights)).apply(
        positions.copy(), random_poses(5), np.ones(5, np.float32)
    )
    assert (shown[:, 1::2] == positions[:, 1::2]).all() and (shown[:, ::2] != positions[:, ::2]).any()


def test_positions_that_are_not_looked_at_may_be_anything(rig, positions):
    """With a strength of 0 no model was executed, and its memory holds what it may."""
    positions[0] = np.nan
    assert np.isfinite(SkinningBlend(rig).apply(positions, random_poses(5), np.float32([0, 1, 0.5, 1, 1]))).all()


def test_another_mask_takes_the_place_of_the_first(rig, positions):
    poses, ones = random_poses(5), np.ones(5, np.float32)
    blend = SkinningBlend(rig, Mask.from_weights(WEIGHTS))
    blend.apply(positions.copy(), poses, ones)
    other = blend.with_mask(Mask.from_weights(1 - WEIGHTS))
    expected = SkinningBlend(rig, Mask.from_weights(1 - WEIGHTS)).apply(positions.copy(), poses, ones)
    assert (other.apply(positions.copy(), poses, ones) == expected).all()
    assert (blend.with_mask(None).apply(positions.copy(), poses, ones) == positions).all()


def test_weights_beyond_zero_and_one_are_brought_to_them():
    mask = Mask.from_weights([-1, 0.5, 3])
    assert mask.weights.tolist() == [0, 0.5, 1] and mask.partial_vertices.tolist() == [0, 1]
    assert mask == Mask.from_weights([0, 0.5, 1]) and mask != Mask.from_weights([0, 0.5, 0.5])
