# SPDX-License-Identifier: GPL-3.0-or-later
"""Blending of a model with linear skinning, by vertex mask and by strength."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..rig import Rig
from .skinning import LinearSkinning


@dataclass(frozen=True)
class Mask:
    """Weight of the model at each vertex of a mesh; linear skinning has the remaining weight.

    Attributes:
        weights: (V,) float32, 0 to 1.
        partial_vertices: (n,) int64, ascending indices of the vertices with a weight below 1.
    """

    weights: np.ndarray
    partial_vertices: np.ndarray

    @staticmethod
    def from_weights(weights: np.ndarray) -> "Mask":
        """Make a mask from (V,) weights, which are clamped to the range 0 to 1."""
        weights = np.clip(np.asarray(weights, np.float32), 0, 1)
        return Mask(weights, np.flatnonzero(weights < 1))

    def blend(self, linear_positions: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Blend (V, 3) float32 positions of one pose: `linear_positions` at weight 0, `positions` at weight 1."""
        blended, weights = positions.copy(), self.weights[self.partial_vertices][:, None]
        blended[self.partial_vertices] = linear_positions[self.partial_vertices] + weights * (
            positions[self.partial_vertices] - linear_positions[self.partial_vertices]
        )
        return blended

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mask) and np.array_equal(self.weights, other.weights)

    __hash__ = None


class SkinningBlend:
    """Blends positions of a model with linear skinning: linear + strength * weight * (model - linear)."""

    def __init__(self, rig: Rig, mask: Mask | None = None):
        """Args:
        rig: the rig, with the skin weights and the rest pose of the model.
        mask: the mask; None for a weight of 1 everywhere.
        """
        self.mask, self._rig = mask, rig

    def with_mask(self, mask: Mask | None) -> "SkinningBlend":
        """Return a copy with another mask."""
        blend = SkinningBlend(self._rig, mask)
        if "_skinning" in vars(self):
            blend._skinning = self._skinning
        return blend

    def apply(self, positions: np.ndarray, pose_matrices: np.ndarray, strengths: np.ndarray) -> np.ndarray:
        """Blend the positions of several poses.

        Args:
            positions: (N, V, 3) float32, computed by the model, mesh-object space, mesh units; may be overwritten.
                Positions of poses with strength 0 are ignored.
            pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
            strengths: (N,) float32, 0 for linear skinning alone, 1 for the model with its mask.

        Returns:
            (N, V, 3) float32, mesh-object space, mesh units; `positions` itself where it was overwritten.
        """
        if strengths.min() < 1:
            linear_positions = self._skinning.positions(pose_matrices)
            model_weights = strengths.astype(np.float32)[:, None]
            if self.mask is not None:
                model_weights = model_weights * self.mask.weights
            has_strength = strengths > 0
            linear_positions[has_strength] += model_weights[has_strength][..., None] * (
                positions[has_strength] - linear_positions[has_strength]
            )
            return linear_positions
        if self.mask is not None and len(self.mask.partial_vertices):
            partial_vertices = self.mask.partial_vertices
            linear_positions = self._partial_skinning.positions(pose_matrices)
            weights = self.mask.weights[partial_vertices][:, None]
            positions[:, partial_vertices] = linear_positions + weights * (
                positions[:, partial_vertices] - linear_positions
            )
        return positions

    @cached_property
    def _skinning(self) -> LinearSkinning:
        return LinearSkinning(self._rig)

    @cached_property
    def _partial_skinning(self) -> LinearSkinning:
        """Return the linear skinning of the partial vertices alone, which is cheaper than to skin the whole mesh."""
        vertices, names = self.mask.partial_vertices, ("rest_positions", "skin_joints", "skin_weights")
        return LinearSkinning(replace(self._rig, **{name: getattr(self._rig, name)[vertices] for name in names}))
