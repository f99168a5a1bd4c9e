# SPDX-License-Identifier: GPL-3.0-or-later
"""A rig that smooths, without Blender: a tube of three joints with delta mush, for tests of the trainer."""

import numpy as np

from fdda_addon.core.partition import make_partitions
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.core.rig import Fingerprint, Joint, Rig
from fdda_addon.core.skinning import LinearSkinning

from .chain import chain_angles, chain_info, pose_chain, rotation

JOINTS, RINGS, AROUND, POSES = 3, 24, 12, 160
ITERATIONS, FACTOR = 6, 0.5


def tube(per_metre: float = 1.0, away: float = 0.0) -> Rig:
    """Create a tube of one meter along z with bulges. It has rings of quads, and each ring is on one joint."""
    height, angle = np.meshgrid(np.linspace(0, 1, RINGS), np.arange(AROUND) * 2 * np.pi / AROUND, indexing="ij")
    radius = 0.08 + 0.015 * np.sin(9 * height) * np.cos(3 * angle)
    positions = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=2).reshape(-1, 3)
    joints = np.minimum((height.ravel() * JOINTS).astype(np.int32), JOINTS - 1)[:, None]
    rest = np.stack([np.eye(4)] * JOINTS)
    rest[:, 2, 3] = np.arange(JOINTS) / JOINTS
    rest = rest @ rotation(0, 0.3)
    rest[:, :3, 3] = per_metre * (rest[:, :3, 3] + away)
    ring, place = np.divmod(np.arange((RINGS - 1) * AROUND), AROUND)
    beside = (place + 1) % AROUND
    faces = AROUND * ring[:, None] + np.stack([place, beside, beside + AROUND, place + AROUND], axis=1)
    positions = (per_metre * (positions + away)).astype(np.float32)
    return Rig(
        tuple(Joint(f"bone_{number}", number - 1) for number in range(JOINTS)),
        positions,
        rest.astype(np.float32),
        joints,
        np.ones(joints.shape, np.float32),
        Fingerprint("tube", Fingerprint.digest(positions), "one"),
        np.arange(0, faces.size, 4, dtype=np.int32),
        faces.astype(np.int32).ravel(),
        metres_per_unit=1 / per_metre,
    )


def smoothed(rig: Rig, positions: np.ndarray) -> np.ndarray:
    """Smooth positions (V, 3) as Blender's Corrective Smooth does in its simple mode."""
    faces = rig.face_vertices.reshape(-1, 4)
    edges = np.concatenate([faces[:, [i, (i + 1) % 4]] for i in range(4)])
    beside = np.zeros((len(positions), len(positions)))
    beside[edges[:, 0], edges[:, 1]] = beside[edges[:, 1], edges[:, 0]] = 1
    beside /= beside.sum(axis=1, keepdims=True)
    for _ in range(ITERATIONS):
        positions = positions + FACTOR * (beside @ positions - positions)
    return positions


def corner_frames(rig: Rig, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (C, 3, 3) axes of the corners in columns, and (C,) their weights, as in Corrective Smooth."""
    faces = positions[rig.face_vertices.reshape(-1, 4)]
    before, after = (np.roll(faces, shift, axis=1) - faces for shift in (1, -1))
    before, after = (edge / np.linalg.norm(edge, axis=2, keepdims=True) for edge in (before, after))
    normal, tangent = np.cross(before, after), before + after
    normal, tangent = (vector / np.linalg.norm(vector, axis=2, keepdims=True) for vector in (normal, tangent))
    frames = np.stack([normal, tangent, np.cross(normal, tangent)], axis=3)
    weights = np.pi - np.arccos(np.clip((before * after).sum(axis=2), -1, 1))
    return frames.reshape(-1, 3, 3), weights.ravel()


def delta_mush(rig: Rig, skinned: np.ndarray) -> np.ndarray:
    """Return (N, V, 3) positions with delta mush, computed from skinned positions."""
    rest = rig.rest_positions.astype(np.float64)
    frames, _ = corner_frames(rig, smoothed(rig, rest))
    deltas = np.einsum("cab,ca->cb", frames, (rest - smoothed(rig, rest))[rig.face_vertices])
    found = []
    for positions in skinned.astype(np.float64):
        positions = smoothed(rig, positions)
        frames, weights = corner_frames(rig, positions)
        moved, total = np.zeros_like(positions), np.zeros(len(positions))
        np.add.at(moved, rig.face_vertices, weights[:, None] * np.einsum("cab,cb->ca", frames, deltas))
        np.add.at(total, rig.face_vertices, weights)
        found.append(positions + moved / total[:, None])
    return np.array(found)


INFLUENCING = {joint: tuple(i for i in (joint, joint + 1) if 0 < i < JOINTS) for joint in range(JOINTS)}


def write_tube(
    path, per_metre: float = 1.0, away: float = 0.0, smooths: bool = True, sheared: bool = False, poses: int = POSES
) -> Recording:
    """Write a recording of the tube with delta mush, or with bulges that depend on the joints without smoothing."""
    plain, rig, angles = tube(), tube(per_metre, away), chain_angles(poses, JOINTS, seed=1, reach=1.5)
    matrices, skinning = pose_chain(plain, angles), LinearSkinning(plain)
    if sheared:
        matrices[:, -1, :3, 0] += 0.4 * np.sin(angles[:, -1, :1]) * matrices[:, -1, :3, 1]
    if smooths:
        residuals = skinning.local_residuals(matrices, delta_mush(plain, skinning.positions(matrices)))
    else:
        waves = np.random.default_rng(2).normal(size=(2, plain.vertex_count, 3))
        residuals = 0.01 * np.einsum("nj,jva->nva", np.sin(7 * angles[:, 1]), waves)
    matrices = matrices.astype(np.float64)
    matrices[:, :, :3, 3] = per_metre * (matrices[:, :, :3, 3] + away)
    with RecordingWriter(path, rig, make_partitions(rig, INFLUENCING), chain_info(poses)) as writer:
        writer.append(matrices.astype(np.float32), (per_metre * residuals).astype(np.float32))
    return read_recording(path)
