# SPDX-License-Identifier: GPL-3.0-or-later
"""A rig that smooths, without Blender: a tube with delta mush on a chain of three joints."""

import numpy as np

from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import Fingerprint, Joint, MeshPart, Rig

from ..recordings import read_skinned, write_recording
from .chain import chain_angles, chain_info, pose_chain, rotation

JOINTS, RING_COUNT, VERTICES_PER_RING, POSES = 3, 24, 12, 160
SMOOTHING_ITERATIONS, SMOOTHING_FACTOR = 6, 0.5


def tube(units_per_metre: float = 1.0, origin_distance: float = 0.0) -> Rig:
    """Create a tube of one meter along z with bulges. It has rings of quads, and each ring is on one joint."""
    height, angle = np.meshgrid(
        np.linspace(0, 1, RING_COUNT), np.arange(VERTICES_PER_RING) * 2 * np.pi / VERTICES_PER_RING, indexing="ij"
    )
    radius = 0.08 + 0.015 * np.sin(9 * height) * np.cos(3 * angle)
    positions = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=2).reshape(-1, 3)
    skin_joints = np.minimum((height.ravel() * JOINTS).astype(np.int32), JOINTS - 1)[:, None]
    rest_matrices = np.stack([np.eye(4)] * JOINTS)
    rest_matrices[:, 2, 3] = np.arange(JOINTS) / JOINTS
    rest_matrices = rest_matrices @ rotation(0, 0.3)
    rest_matrices[:, :3, 3] = units_per_metre * (rest_matrices[:, :3, 3] + origin_distance)
    ring, ring_vertex = np.divmod(np.arange((RING_COUNT - 1) * VERTICES_PER_RING), VERTICES_PER_RING)
    next_vertex = (ring_vertex + 1) % VERTICES_PER_RING
    faces = VERTICES_PER_RING * ring[:, None] + np.stack(
        [ring_vertex, next_vertex, next_vertex + VERTICES_PER_RING, ring_vertex + VERTICES_PER_RING], axis=1
    )
    positions = (units_per_metre * (positions + origin_distance)).astype(np.float32)
    return Rig(
        tuple(Joint(f"bone_{index}", index - 1) for index in range(JOINTS)),
        positions,
        rest_matrices.astype(np.float32),
        skin_joints,
        np.ones(skin_joints.shape, np.float32),
        (MeshPart("tube", len(positions), Fingerprint("tube", Fingerprint.digest(positions), "one")),),
        np.arange(0, faces.size, 4, dtype=np.int32),
        faces.astype(np.int32).ravel(),
        metres_per_unit=1 / units_per_metre,
    )


def smoothed(rig: Rig, positions: np.ndarray) -> np.ndarray:
    """Smooth positions (V, 3) as Blender's Corrective Smooth does in its simple mode."""
    faces = rig.face_vertices.reshape(-1, 4)
    edges = np.concatenate([faces[:, [corner, (corner + 1) % 4]] for corner in range(4)])
    neighbor_weights = np.zeros((len(positions), len(positions)))
    neighbor_weights[edges[:, 0], edges[:, 1]] = neighbor_weights[edges[:, 1], edges[:, 0]] = 1
    neighbor_weights /= neighbor_weights.sum(axis=1, keepdims=True)
    for _ in range(SMOOTHING_ITERATIONS):
        positions = positions + SMOOTHING_FACTOR * (neighbor_weights @ positions - positions)
    return positions


def corner_frames(rig: Rig, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (C, 3, 3) axes of the corners in columns, and (C,) their weights, as in Corrective Smooth."""
    faces = positions[rig.face_vertices.reshape(-1, 4)]
    predecessor_edges, successor_edges = (np.roll(faces, shift, axis=1) - faces for shift in (1, -1))
    predecessor_edges, successor_edges = (
        edges / np.linalg.norm(edges, axis=2, keepdims=True) for edges in (predecessor_edges, successor_edges)
    )
    normals, tangents = np.cross(predecessor_edges, successor_edges), predecessor_edges + successor_edges
    normals, tangents = (vectors / np.linalg.norm(vectors, axis=2, keepdims=True) for vectors in (normals, tangents))
    axes = np.stack([normals, tangents, np.cross(normals, tangents)], axis=3)
    weights = np.pi - np.arccos(np.clip((predecessor_edges * successor_edges).sum(axis=2), -1, 1))
    return axes.reshape(-1, 3, 3), weights.ravel()


def delta_mush(rig: Rig, skinned: np.ndarray) -> np.ndarray:
    """Apply delta mush to (N, V, 3) skinned positions; returns (N, V, 3) positions."""
    rest = rig.rest_positions.astype(np.float64)
    axes, _ = corner_frames(rig, smoothed(rig, rest))
    deltas = np.einsum("cab,ca->cb", axes, (rest - smoothed(rig, rest))[rig.face_vertices])
    results = []
    for positions in skinned.astype(np.float64):
        positions = smoothed(rig, positions)
        axes, weights = corner_frames(rig, positions)
        offset_sums, weight_sums = np.zeros_like(positions), np.zeros(len(positions))
        np.add.at(offset_sums, rig.face_vertices, weights[:, None] * np.einsum("cab,cb->ca", axes, deltas))
        np.add.at(weight_sums, rig.face_vertices, weights)
        results.append(positions + offset_sums / weight_sums[:, None])
    return np.array(results)


INFLUENCING = {joint: tuple(i for i in (joint, joint + 1) if 0 < i < JOINTS) for joint in range(JOINTS)}


def write_tube(
    path,
    units_per_metre: float = 1.0,
    origin_distance: float = 0.0,
    smooths: bool = True,
    sheared: bool = False,
    pose_count: int = POSES,
) -> SkinnedRecording:
    """Write a recording of the tube with delta mush; with `smooths` False, with bulges that depend on joint angles."""
    plain_rig, rig, angles = (
        tube(),
        tube(units_per_metre, origin_distance),
        chain_angles(pose_count, JOINTS, seed=1, range_scale=1.5),
    )
    matrices, skinning = pose_chain(plain_rig, angles), LinearSkinning(plain_rig)
    if sheared:
        matrices[:, -1, :3, 0] += 0.4 * np.sin(angles[:, -1, :1]) * matrices[:, -1, :3, 1]
    if smooths:
        residuals = skinning.local_residuals(matrices, delta_mush(plain_rig, skinning.positions(matrices)))
    else:
        waves = np.random.default_rng(2).normal(size=(2, plain_rig.vertex_count, 3))
        residuals = 0.01 * np.einsum("nj,jva->nva", np.sin(7 * angles[:, 1]), waves)
    matrices = matrices.astype(np.float64)
    matrices[:, :, :3, 3] = units_per_metre * (matrices[:, :, :3, 3] + origin_distance)
    write_recording(
        path,
        rig,
        make_partitions(rig, INFLUENCING),
        chain_info(pose_count),
        matrices.astype(np.float32),
        (units_per_metre * residuals).astype(np.float32),
    )
    return read_skinned(path)
