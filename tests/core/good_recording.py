# SPDX-License-Identifier: GPL-3.0-or-later
"""A recording in memory that causes no warning: a tube on a chain of joints, with smooth bulges as residuals."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fdda_addon.core.checks.recording import check_recording
from fdda_addon.core.controls import Control
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.mathematics.poses import Channel
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.index import RecordingInfo, Sampling, Source
from fdda_addon.core.rig import Fingerprint, Joint, MeshPart, Rig

from ..recordings import ResidualRecording, make_recording

JOINTS = (Joint("root", -1), Joint("upper", 0), Joint("lower", 1), Joint("hand", 2))
BONE_LENGTH, RADIUS = 0.25, 0.05
"""Sizes of the tube, meters."""
CONTROLS = (Control("shape_keys", 'key_blocks["Bulge"].value', 0.0, 1.0),)
ROTATION_LIMIT = 0.8
"""Each joint rotates about X between minus and plus this angle, radians."""
RING_COUNT, VERTICES_PER_RING = 24, 10


def good_rig() -> Rig:
    """Return a tube of `RING_COUNT` rings along +Z, smoothly skinned to joints that are `BONE_LENGTH` apart."""
    heights = np.repeat(np.linspace(0.01, len(JOINTS) * BONE_LENGTH - 0.01, RING_COUNT), VERTICES_PER_RING)
    ring_angles = np.tile(np.arange(VERTICES_PER_RING) * 2 * np.pi / VERTICES_PER_RING, RING_COUNT)
    positions = np.stack([RADIUS * np.cos(ring_angles), RADIUS * np.sin(ring_angles), heights], axis=1).astype(
        np.float32
    )
    joint_coordinates = np.clip(heights / BONE_LENGTH - 0.5, 0, len(JOINTS) - 1)
    lower_joints = np.minimum(joint_coordinates.astype(np.int32), len(JOINTS) - 2)
    skin_joints = np.stack([lower_joints, lower_joints + 1], axis=1).astype(np.int32)
    upper_weights = (joint_coordinates - lower_joints).astype(np.float32)
    rest_matrices = np.stack([np.eye(4, dtype=np.float32)] * len(JOINTS))
    rest_matrices[:, 2, 3] = np.arange(len(JOINTS)) * BONE_LENGTH
    skin_weights = np.stack([1 - upper_weights, upper_weights], axis=1)
    meshes = (MeshPart("tube", len(positions), Fingerprint("a", "b", "c")),)
    return Rig(JOINTS, positions, rest_matrices, skin_joints, skin_weights, meshes, controls=CONTROLS)


def axis_rotations(angles: np.ndarray, axis: int = 0) -> np.ndarray:
    """Return (..., 4, 4) rotation matrices about a coordinate axis, for (...) angles in radians."""
    matrices = np.zeros((*angles.shape, 4, 4))
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrices[..., axis, axis] = matrices[..., 3, 3] = 1
    matrices[..., i, i] = matrices[..., j, j] = np.cos(angles)
    matrices[..., j, i], matrices[..., i, j] = np.sin(angles), -np.sin(angles)
    return matrices


def pose_rig(rig: Rig, local_transforms: np.ndarray) -> np.ndarray:
    """Compute (N, J, 4, 4) float32 pose matrices from (N, J, 4, 4) transforms relative to the rest pose."""
    rest_matrices, pose_matrices = rig.rest_matrices.astype(np.float64), np.empty(local_transforms.shape)
    for joint, (_, parent) in enumerate((j.name, j.parent) for j in rig.joints):
        unposed = (
            rest_matrices[joint]
            if parent < 0
            else pose_matrices[:, parent] @ np.linalg.inv(rest_matrices[parent]) @ rest_matrices[joint]
        )
        pose_matrices[:, joint] = unposed @ local_transforms[:, joint]
    return pose_matrices.astype(np.float32)


def good_recording(poses: int = 200, angles: np.ndarray | None = None, seed: int = 0) -> ResidualRecording:
    """Return a recording of the tube; the joints rotate about X, and joints and control make the tube bulge.

    Args:
        poses, seed: number of random poses and their seed.
        angles: (N, J) rotations about X in radians; random ones when left out.
    """
    rig, rng = good_rig(), np.random.default_rng(seed)
    if angles is None:
        angles = rng.uniform(-ROTATION_LIMIT, ROTATION_LIMIT, (poses, len(JOINTS)))
    controls = rng.uniform(0, 1, (len(angles), 1)).astype(np.float32)
    heights = rig.rest_positions[:, 2] / BONE_LENGTH
    residuals = np.zeros((len(angles), rig.vertex_count, 3), np.float32)
    for joint in range(1, len(JOINTS)):
        falloff = np.exp(-(((heights - joint) / 0.4) ** 2))
        residuals[:, :, 0] += 0.02 * np.sin(angles[:, joint, None]) ** 2 * falloff
    residuals[:, :, 1] += 0.01 * controls * np.exp(-((heights - 1.5) ** 2))
    influencing = {j: tuple(i for i in (j, j + 1) if 0 < i < len(JOINTS)) for j in range(len(JOINTS))}
    partitions = make_partitions(rig, influencing, dict.fromkeys(range(len(JOINTS)), (0,)))
    channels = tuple(Channel(joint.name, "rotation", 0, -ROTATION_LIMIT, ROTATION_LIMIT) for joint in JOINTS)
    sampling = Sampling(seed, 1.0, channels, (Source("random", len(angles)),))
    info = RecordingInfo(len(angles), len(angles), "tube.blend", "5.2.0", sampling)
    matrices = pose_rig(rig, axis_rotations(angles))
    return make_recording(Path("tube"), info, rig, partitions, matrices, residuals, controls)


def with_rig(recording: ResidualRecording, **changes: object) -> ResidualRecording:
    """Return the recording with changed fields of its rig; poses and residuals stay the same."""
    rig = replace(recording.rig, **changes)
    return replace(recording, rig=rig)


def with_positions(recording: ResidualRecording, positions: np.ndarray) -> ResidualRecording:
    """Return the recording with the residuals that follow when the rig evaluates to these (N, V, 3) positions."""
    skinning = LinearSkinning(recording.rig, recording.partitions)
    return replace(recording, residuals=skinning.local_residuals(recording.pose_matrices, positions))


def warning_texts(recording: ResidualRecording) -> dict[str, str]:
    """Check the recording and return the text of each warning by its name."""
    return {warning.name: warning.text for warning in check_recording(recording)}


def single_warning_text(recording: ResidualRecording, name: str) -> str:
    """Check that the recording causes one warning, of this name, and return its text."""
    texts = warning_texts(recording)
    assert list(texts) == [name]
    return texts[name]


def with_partitions(recording: ResidualRecording, **changes) -> ResidualRecording:
    """Return the recording with the same changed fields in each of its partitions."""
    return replace(recording, partitions=tuple(replace(p, **changes) for p in recording.partitions))
