# SPDX-License-Identifier: GPL-3.0-or-later
"""Linear skinning and local residuals.

Matrices act on column vectors. A skin matrix is S_j = P_j B_j^-1, from the rest pose to the pose, both in
mesh-object space (Bailey et al. 2018, section 3).
"""

from collections.abc import Iterator

import numpy as np

from ..errors import RigError
from ..rig import Rig
from .partition import Partition, make_partitions


def skin_matrices(pose_matrices: np.ndarray, rest_matrices: np.ndarray) -> np.ndarray:
    """Compute skin matrices S_j = P_j B_j^-1.

    Args:
        pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
        rest_matrices: (J, 4, 4), mesh-object space, mesh units.

    Returns:
        (N, J, 4, 4) float32.
    """
    return (pose_matrices @ np.linalg.inv(rest_matrices.astype(np.float64))).astype(np.float32)


MIN_COLUMN_LENGTH = 1e-12
"""Smallest length of a column of an invertible matrix."""
MIN_COLUMN_VOLUME = 1e-6
"""Smallest volume of the parallelepiped that the three normalized columns of an invertible matrix span."""


def are_invertible(matrices: np.ndarray) -> np.ndarray:
    """Return (...,) bool: which of (..., 4, 4) matrices are invertible affine transforms."""
    columns = matrices[..., :3, :3].astype(np.float64)
    lengths = np.linalg.norm(columns, axis=-2)
    unit_columns = columns / np.maximum(lengths, MIN_COLUMN_LENGTH)[..., None, :]
    volume = np.abs(
        np.einsum("...a,...a->...", np.cross(unit_columns[..., 0], unit_columns[..., 1]), unit_columns[..., 2])
    )
    is_affine = np.abs(matrices[..., 3, :] - np.array([0, 0, 0, 1])).max(axis=-1) <= 1e-3
    return (lengths > MIN_COLUMN_LENGTH).all(axis=-1) & (volume > MIN_COLUMN_VOLUME) & is_affine


class SkinBlock:
    """Linear skinning of some vertices that share a main joint, expressed as one constant matrix.

    Let S be the horizontally stacked skin matrices of the vertices' joints. `S @ weighted_rest` skins all vertices:
    one matrix product replaces a gather for each skin weight.

    Attributes:
        main_joint: the main joint.
        joints: (Jp,) int32, joints with a weight on a vertex.
        weighted_rest: (4 Jp, Vp) float32, w_vj (x_v, 1), mesh units.
    """

    def __init__(self, rig: Rig, main_joint: int, vertices: np.ndarray):
        self.main_joint = main_joint
        skin_joints, skin_weights = rig.skin_joints[vertices], rig.skin_weights[vertices]
        self.joints = np.unique(skin_joints[skin_weights > 0]).astype(np.int32)
        dense_weights = np.zeros((len(self.joints), len(vertices)), np.float32)
        for slot in range(skin_joints.shape[1]):
            vertices_in_slot = np.flatnonzero(skin_weights[:, slot] > 0)
            dense_weights[np.searchsorted(self.joints, skin_joints[vertices_in_slot, slot]), vertices_in_slot] += (
                skin_weights[vertices_in_slot, slot]
            )
        homogeneous_rest = np.concatenate(
            [rig.rest_positions[vertices], np.ones((len(vertices), 1), np.float32)], axis=1
        )
        self.weighted_rest = (dense_weights[:, None, :] * homogeneous_rest.T[None]).reshape(-1, len(vertices))

    def skin(self, skin: np.ndarray) -> np.ndarray:
        """Skin the vertices with (N, J, 3, 4) skin matrices; returns (N, Vp, 3), mesh units."""
        # One product per pose: in one product for all poses, the last bits would depend on the number of poses.
        rows = skin[:, self.joints].transpose(0, 2, 1, 3).reshape(len(skin), 3, -1)
        return (rows @ self.weighted_rest).transpose(0, 2, 1)

    def subtract_from(self, positions: np.ndarray, skin: np.ndarray) -> None:
        """Turn (N, Vp, 3) positions into local residuals, in place; `skin` as in `LinearSkinning.local_residuals`."""
        positions -= self.skin(skin)
        positions[:] = positions @ np.linalg.inv(skin[:, self.main_joint, :, :3]).transpose(0, 2, 1)


class LinearSkinning:
    """Linear blend skinning of a rig, and local residuals relative to it."""

    def __init__(self, rig: Rig, partitions: tuple[Partition, ...] | None = None):
        self.rig = rig
        self.partitions = make_partitions(rig) if partitions is None else partitions
        self._blocks = [SkinBlock(rig, partition.joint, partition.vertices) for partition in self.partitions]
        # One gather of all vertices, sorted by partition, is far cheaper than one gather per partition.
        self._order = np.concatenate([partition.vertices for partition in self.partitions])
        self._inverse_order = np.argsort(self._order)

    def positions(self, pose_matrices: np.ndarray) -> np.ndarray:
        """Skin the mesh.

        Args:
            pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.

        Returns:
            (N, V, 3) float32, mesh-object space, mesh units.
        """
        skin = skin_matrices(pose_matrices, self.rig.rest_matrices)[:, :, :3, :]
        ordered = np.empty((len(skin), self.rig.vertex_count, 3), np.float32)
        for block, values in self._iterate_blocks(ordered):
            values[:] = block.skin(skin)
        return np.take(ordered, self._inverse_order, axis=1)

    def local_residuals(self, pose_matrices: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Compute residuals in the space of the main joints, l_v = R_m^-1 (complex_v - lin_v).

        Args:
            pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
            positions: (N, V, 3) positions that the rig evaluates, mesh-object space, mesh units.

        Returns:
            (N, V, 3) float32, axes of the main joint, mesh units.

        Raises:
            RigError: a joint has a scale of zero in some pose.
        """
        skin = skin_matrices(pose_matrices, self.rig.rest_matrices)[:, :, :3, :]
        ordered = np.take(np.asarray(positions, np.float32), self._order, axis=1)
        try:
            for block, values in self._iterate_blocks(ordered):
                block.subtract_from(values, skin)
        except np.linalg.LinAlgError as error:
            smallest_volumes = np.abs(np.linalg.det(pose_matrices[:, :, :3, :3].astype(np.float64))).min(axis=0)
            raise RigError(
                f"Bone '{self.rig.joint_names[int(smallest_volumes.argmin())]}' has a scale of zero in some pose; "
                "look for the key, constraint or driver that sets it."
            ) from error
        return np.take(ordered, self._inverse_order, axis=1)

    def complex_positions(self, pose_matrices: np.ndarray, local_residuals: np.ndarray) -> np.ndarray:
        """Invert `local_residuals`: compute lin_v + R_m l_v.

        Args:
            pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
            local_residuals: (N, V, 3), axes of the main joint, mesh units.

        Returns:
            (N, V, 3) float32, mesh-object space, mesh units.
        """
        skin = skin_matrices(pose_matrices, self.rig.rest_matrices)[:, :, :3, :]
        ordered = np.take(np.asarray(local_residuals, np.float32), self._order, axis=1)
        for block, values in self._iterate_blocks(ordered):
            values[:] = values @ skin[:, block.main_joint, :, :3].transpose(0, 2, 1)
            values += block.skin(skin)
        return np.take(ordered, self._inverse_order, axis=1)

    def _iterate_blocks(self, ordered: np.ndarray) -> Iterator[tuple[SkinBlock, np.ndarray]]:
        """Yield each block with its view into an (N, V, 3) array sorted by partition."""
        start = 0
        for block in self._blocks:
            vertex_count = block.weighted_rest.shape[1]
            yield block, ordered[:, start : start + vertex_count]
            start += vertex_count
