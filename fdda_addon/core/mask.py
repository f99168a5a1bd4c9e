# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a model counts: a weight for each vertex, 1 for the model and 0 for linear skinning."""

from dataclasses import dataclass, replace

import numpy as np

from .rig import Rig
from .skinning import LinearSkinning


@dataclass(frozen=True)
class Mask:
    """A weight for each vertex of a mesh.

    Attributes:
        weights: (V,) float32, 0 to 1.
        partial: (n,) int64, ascending: the vertices with less than 1, which are not the model's alone.
    """

    weights: np.ndarray
    partial: np.ndarray

    @staticmethod
    def from_weights(weights: np.ndarray) -> "Mask":
        """The mask with these weights, (V,); what is beyond 0 and 1 is brought to them."""
        weights = np.clip(np.asarray(weights, np.float32), 0, 1)
        return Mask(weights, np.flatnonzero(weights < 1))

    def blended(self, linear: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Of one pose, (V, 3) float32 each: the model's positions where it counts, linear skinning's elsewhere."""
        blended, weights = positions.copy(), self.weights[self.partial][:, None]
        blended[self.partial] = linear[self.partial] + weights * (positions[self.partial] - linear[self.partial])
        return blended

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mask) and np.array_equal(self.weights, other.weights)

    __hash__ = None


class SkinningBlend:
    """Blends what a model gives with linear skinning: linear + strength * weight * (model - linear)."""

    def __init__(self, rig: Rig, mask: Mask | None = None):
        """Args:
        rig: with the skin weights of the model's linear skinning, and the rest pose of the model.
        mask: of its mesh; None where the model counts everywhere.
        """
        self.mask = mask
        self._rig = rig
        self._full_skinning: LinearSkinning | None = None
        self._partial_skinning: LinearSkinning | None = None

    def with_mask(self, mask: Mask | None) -> "SkinningBlend":
        """The same with another mask."""
        other = SkinningBlend(self._rig, mask)
        other._full_skinning = self._full_skinning
        return other

    def apply(self, positions: np.ndarray, pose_matrices: np.ndarray, strengths: np.ndarray) -> np.ndarray:
        """Blend some poses.

        Args:
            positions: (N, V, 3) float32 of the model, mesh units; may be written into. Not looked at where the
                strength is 0.
            pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
            strengths: (N,) float32, 0 for linear skinning alone, 1 for the model where the mask lets it.

        Returns:
            (N, V, 3) float32, mesh-object space, mesh units; `positions` itself where it was written into.
        """
        if strengths.min() < 1:
            linear = self._make_full_skinning().positions(pose_matrices)
            factors = strengths.astype(np.float32)[:, None]
            if self.mask is not None:
                factors = factors * self.mask.weights
            shown = strengths > 0
            linear[shown] += factors[shown][..., None] * (positions[shown] - linear[shown])
            return linear
        if self.mask is not None and len(self.mask.partial):
            partial = self.mask.partial
            linear = self._make_partial_skinning().positions(pose_matrices)
            weights = self.mask.weights[partial][:, None]
            positions[:, partial] = linear + weights * (positions[:, partial] - linear)
        return positions

    def _make_full_skinning(self) -> LinearSkinning:
        if self._full_skinning is None:
            self._full_skinning = LinearSkinning(self._rig)
        return self._full_skinning

    def _make_partial_skinning(self) -> LinearSkinning:
        """Of the vertices alone that the model does not have for itself: a mask costs as much as it covers."""
        if self._partial_skinning is None:
            rig, partial = self._rig, self.mask.partial
            self._partial_skinning = LinearSkinning(
                replace(
                    rig,
                    rest_positions=rig.rest_positions[partial],
                    skin_joints=rig.skin_joints[partial],
                    skin_weights=rig.skin_weights[partial],
                )
            )
        return self._partial_skinning
