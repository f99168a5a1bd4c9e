# SPDX-License-Identifier: GPL-3.0-or-later
"""A small rig without Blender: a tube on a chain of joints. Its residuals depend on the bends of the joints."""

from pathlib import Path

import numpy as np
import onnx

from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.mathematics.poses import Channel
from fdda_addon.core.recording.index import RecordingInfo, Sampling, Source
from fdda_addon.core.rig import Fingerprint, Joint, MeshPart, Rig

from ..recordings import write_recording

MAX_ANGLE = 0.9
"""Largest angle of every joint about x and about z, in both directions, radians."""


def rotation(axis: int, angle: float) -> np.ndarray:
    """Return the (4, 4) rotation about a coordinate axis by an angle in radians."""
    matrix, (i, j) = np.eye(4), [(1, 2), (2, 0), (0, 1)][axis]
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[j, i], matrix[i, j] = np.sin(angle), -np.sin(angle)
    return matrix


def chain_rig(joint_count: int = 3, vertex_count: int = 90, seed: int = 0) -> Rig:
    """Create a tube of one meter along z with smooth skin weights on a chain of joints and vertices in random order."""
    rng = np.random.default_rng(seed)
    rest_matrices = np.stack([np.eye(4)] * joint_count)
    rest_matrices[:, 2, 3] = np.arange(joint_count) / joint_count
    rest_matrices = rest_matrices @ rotation(0, 0.3)
    height, angle = rng.permutation(np.linspace(0.01, 0.99, vertex_count)), rng.uniform(0, 2 * np.pi, vertex_count)
    positions = np.stack([0.06 * np.cos(angle), 0.06 * np.sin(angle), height], axis=1).astype(np.float32)
    joint_coordinate = height * joint_count - 0.5
    lower_joints = np.clip(np.floor(joint_coordinate).astype(int), 0, joint_count - 1)
    upper_joints = np.minimum(lower_joints + 1, joint_count - 1)
    upper_weights = np.clip(joint_coordinate - lower_joints, 0, 1) * (upper_joints > lower_joints)
    skin_joints = np.stack([lower_joints, np.where(upper_weights > 0, upper_joints, 0)], axis=1).astype(np.int32)
    skin_weights = np.stack([1 - upper_weights, upper_weights], axis=1).astype(np.float32)
    joints = tuple(Joint(f"bone_{index}", index - 1) for index in range(joint_count))
    fingerprint = Fingerprint("chain", Fingerprint.digest(positions), Fingerprint.digest(skin_weights))
    meshes = (MeshPart("chain", len(positions), fingerprint),)
    faces = chain_faces(height)
    return Rig(joints, positions, rest_matrices.astype(np.float32), skin_joints, skin_weights, meshes, *faces)


def chain_faces(height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and vertices of the faces, which are triangles of three consecutive vertices along the tube."""
    order = np.argsort(height)
    vertices = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
    return np.arange(0, vertices.size, 3, dtype=np.int32), vertices.astype(np.int32).ravel()


def chain_angles(pose_count: int, joint_count: int, seed: int, range_scale: float = 1.0) -> np.ndarray:
    """Draw (N, J, 2) angles about x and z, uniform in `range_scale` times the range of motion; 0 for the root."""
    angles = np.random.default_rng(seed).uniform(
        -MAX_ANGLE * range_scale, MAX_ANGLE * range_scale, (pose_count, joint_count, 2)
    )
    angles[:, 0] = 0
    return angles


def pose_chain(rig: Rig, angles: np.ndarray) -> np.ndarray:
    """Convert (N, J, 2) angles to (N, J, 4, 4) float32 pose matrices."""
    rest_matrices = rig.rest_matrices.astype(np.float64)
    matrices = np.empty((len(angles), len(rig.joints), 4, 4))
    for pose, pose_angles in enumerate(angles):
        for joint, (x, z) in enumerate(pose_angles):
            parent = rig.joints[joint].parent
            carried_matrix = rest_matrices[joint]
            if parent >= 0:
                carried_matrix = matrices[pose, parent] @ np.linalg.inv(rest_matrices[parent]) @ rest_matrices[joint]
            matrices[pose, joint] = carried_matrix @ rotation(0, x) @ rotation(2, z)
    return matrices.astype(np.float32)


def chain_residuals(rig: Rig, angles: np.ndarray) -> np.ndarray:
    """Return (N, V, 3) float32 local residuals: bulges of some millimeters that grow with nearby bends."""
    joint_coordinate = rig.rest_positions[:, 2] * len(rig.joints)
    residuals = np.zeros((len(angles), rig.vertex_count, 3), np.float32)
    for joint in range(1, len(rig.joints)):
        falloff = np.exp(-(((joint_coordinate - joint) / 0.4) ** 2))
        bulges = np.sin(angles[:, joint]) ** 2 * 0.02
        residuals[:, :, 0] += bulges[:, :1] * falloff
        residuals[:, :, 1] += bulges[:, 1:] * falloff * np.cos(7 * joint_coordinate)
    return residuals


def write_chain(path: Path, pose_count: int = 120, joint_count: int = 3, seed: int = 0) -> Rig:
    """Write a recording of the chain with its last joint locked about z."""
    rig = chain_rig(joint_count)
    angles = chain_angles(pose_count, joint_count, seed)
    angles[:, joint_count - 1, 1] = 0
    influencing = {
        joint: tuple(other for other in (joint, joint + 1) if 0 < other < joint_count) for joint in range(joint_count)
    }
    partitions, info = make_partitions(rig, influencing), chain_info(pose_count, seed)
    write_recording(path, rig, partitions, info, pose_chain(rig, angles), chain_residuals(rig, angles))
    return rig


def chain_info(pose_count: int, seed: int = 0) -> RecordingInfo:
    """Create the index of a recording of random poses."""
    limits = (Channel("bone_1", "rotation", 0, -MAX_ANGLE, MAX_ANGLE),)
    sampling = Sampling(seed, 1.0, limits, (Source("random", pose_count),))
    return RecordingInfo(pose_count, 0, "chain.blend", "5.2.0", sampling)


def constant_names(graph: onnx.GraphProto) -> set[str]:
    """Return the names of all values that depend on constants alone, which ONNX Runtime computes while it loads."""
    names = {tensor.name for tensor in graph.initializer}
    for node in graph.node:
        if names.issuperset(node.input):
            names.update(node.output)
    return names
