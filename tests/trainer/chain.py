# SPDX-License-Identifier: GPL-3.0-or-later
"""A small rig without Blender: a tube on a chain of joints whose residual bends with them."""

from pathlib import Path

import numpy as np

from fdda_addon.core.partition import make_partitions
from fdda_addon.core.poses import Channel
from fdda_addon.core.recording.index import RecordingInfo, Sampling, Source
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.core.rig import Fingerprint, Joint, Rig

LIMIT = 0.9
"""Range of motion of every joint about x and z, radians."""


def rotation(axis: int, angle: float) -> np.ndarray:
    """Return the (4, 4) rotation about a coordinate axis by an angle in radians."""
    matrix, (i, j) = np.eye(4), [(1, 2), (2, 0), (0, 1)][axis]
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[j, i], matrix[i, j] = np.sin(angle), -np.sin(angle)
    return matrix


def chain_rig(joints: int = 3, vertices: int = 90, seed: int = 0) -> Rig:
    """Create a tube of one meter along z, smoothly skinned to a chain of joints. Vertices are in random order."""
    rng = np.random.default_rng(seed)
    rest = np.stack([np.eye(4)] * joints)
    rest[:, 2, 3] = np.arange(joints) / joints
    rest = rest @ rotation(0, 0.3)
    height, angle = rng.permutation(np.linspace(0.01, 0.99, vertices)), rng.uniform(0, 2 * np.pi, vertices)
    positions = np.stack([0.06 * np.cos(angle), 0.06 * np.sin(angle), height], axis=1).astype(np.float32)
    along = height * joints - 0.5
    first = np.clip(np.floor(along).astype(int), 0, joints - 1)
    second = np.minimum(first + 1, joints - 1)
    weight = np.clip(along - first, 0, 1) * (second > first)
    skin_joints = np.stack([first, np.where(weight > 0, second, 0)], axis=1).astype(np.int32)
    skin_weights = np.stack([1 - weight, weight], axis=1).astype(np.float32)
    chain = tuple(Joint(f"bone_{number}", number - 1) for number in range(joints))
    fingerprint = Fingerprint("chain", Fingerprint.digest(positions), Fingerprint.digest(skin_weights))
    faces = chain_faces(height)
    return Rig(chain, positions, rest.astype(np.float32), skin_joints, skin_weights, fingerprint, *faces)


def chain_faces(height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and vertices of triangles, each of three consecutive vertices along the tube."""
    order = np.argsort(height)
    vertices = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
    return np.arange(0, vertices.size, 3, dtype=np.int32), vertices.astype(np.int32).ravel()


def chain_angles(poses: int, joints: int, seed: int, reach: float = 1.0) -> np.ndarray:
    """Draw (poses, joints, 2) angles about x and z, uniform in `reach` times the range of motion; the root is still."""
    angles = np.random.default_rng(seed).uniform(-LIMIT * reach, LIMIT * reach, (poses, joints, 2))
    angles[:, 0] = 0
    return angles


def pose_chain(rig: Rig, angles: np.ndarray) -> np.ndarray:
    """Convert (N, J, 2) angles to (N, J, 4, 4) float32 pose matrices."""
    rest = rig.rest_matrices.astype(np.float64)
    matrices = np.empty((len(angles), len(rig.joints), 4, 4))
    for pose, by_joint in enumerate(angles):
        for joint, (x, z) in enumerate(by_joint):
            parent = rig.joints[joint].parent
            base = rest[joint]
            if parent >= 0:
                base = matrices[pose, parent] @ np.linalg.inv(rest[parent]) @ rest[joint]
            matrices[pose, joint] = base @ rotation(0, x) @ rotation(2, z)
    return matrices.astype(np.float32)


def chain_residuals(rig: Rig, angles: np.ndarray) -> np.ndarray:
    """Return (N, V, 3) float32 local residuals: bulges of some millimeters that grow with nearby bends."""
    position = rig.rest_positions[:, 2] * len(rig.joints)
    residuals = np.zeros((len(angles), rig.vertex_count, 3), np.float32)
    for joint in range(1, len(rig.joints)):
        near = np.exp(-(((position - joint) / 0.4) ** 2))
        bend = np.sin(angles[:, joint]) ** 2 * 0.02
        residuals[:, :, 0] += bend[:, :1] * near
        residuals[:, :, 1] += bend[:, 1:] * near * np.cos(7 * position)
    return residuals


def write_chain(path: Path, poses: int = 120, complete: int | None = None, joints: int = 3, seed: int = 0) -> Rig:
    """Write a recording of the chain with its last joint locked; `complete` poses of it are written, None for all."""
    rig = chain_rig(joints)
    angles = chain_angles(poses, joints, seed)
    angles[:, joints - 1, 1] = 0
    influencing = {j: tuple(i for i in (j, j + 1) if 0 < i < joints) for j in range(joints)}
    info = chain_info(poses, seed)
    written_angles = angles[: poses if complete is None else complete]
    with RecordingWriter(path, rig, make_partitions(rig, influencing), info) as writer:
        writer.append(pose_chain(rig, written_angles), chain_residuals(rig, written_angles))
    return rig


def chain_info(poses: int, seed: int = 0) -> RecordingInfo:
    """Create the index of a recording of random poses."""
    limits = (Channel("bone_1", "rotation", 0, -LIMIT, LIMIT),)
    sampling = Sampling(seed, 1.0, limits, (Source("random", poses),))
    return RecordingInfo(poses, 0, "chain.blend", "chain", "5.2.0", sampling)
