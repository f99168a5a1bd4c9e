# SPDX-License-Identifier: GPL-3.0-or-later
"""A recording without anything to warn of, in memory: a smoothly bulging tube on a chain of joints."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fdda_addon.core.checks.recording import check_recording
from fdda_addon.core.controls import Control
from fdda_addon.core.partition import make_partitions
from fdda_addon.core.poses import Channel
from fdda_addon.core.recording.index import RecordingInfo, Sampling, Source
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.rig import Fingerprint, Joint, Rig
from fdda_addon.core.skinning import LinearSkinning

JOINTS = (Joint("root", -1), Joint("upper", 0), Joint("lower", 1), Joint("hand", 2))
BONE, RADIUS = 0.25, 0.05
CONTROLS = (Control("shape_keys", 'key_blocks["Bulge"].value', 0.0, 1.0),)
LIMIT = 0.8
"""Range of motion of each joint about X, radians."""
RINGS, AROUND = 24, 10


def good_rig() -> Rig:
    """A tube of `RINGS` along +Z, smoothly skinned to joints a `BONE` apart."""
    height = np.repeat(np.linspace(0.01, len(JOINTS) * BONE - 0.01, RINGS), AROUND)
    around = np.tile(np.arange(AROUND) * 2 * np.pi / AROUND, RINGS)
    positions = np.stack([RADIUS * np.cos(around), RADIUS * np.sin(around), height], axis=1).astype(np.float32)
    along = np.clip(height / BONE - 0.5, 0, len(JOINTS) - 1)
    first = np.minimum(along.astype(np.int32), len(JOINTS) - 2)
    skin_joints = np.stack([first, first + 1], axis=1).astype(np.int32)
    weight = (along - first).astype(np.float32)
    rest = np.stack([np.eye(4, dtype=np.float32)] * len(JOINTS))
    rest[:, 2, 3] = np.arange(len(JOINTS)) * BONE
    skin_weights = np.stack([1 - weight, weight], axis=1)
    return Rig(JOINTS, positions, rest, skin_joints, skin_weights, Fingerprint("a", "b", "c"), controls=CONTROLS)


def turns(angles: np.ndarray, axis: int = 0) -> np.ndarray:
    """(...) angles in radians to (..., 4, 4) rotations about a coordinate axis."""
    matrices = np.zeros((*angles.shape, 4, 4))
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrices[..., axis, axis] = matrices[..., 3, 3] = 1
    matrices[..., i, i] = matrices[..., j, j] = np.cos(angles)
    matrices[..., j, i], matrices[..., i, j] = np.sin(angles), -np.sin(angles)
    return matrices


def pose_rig(rig: Rig, local: np.ndarray) -> np.ndarray:
    """(N, J, 4, 4) transforms relative to the rest pose to (N, J, 4, 4) float32 pose matrices."""
    rest, pose = rig.rest_matrices.astype(np.float64), np.empty(local.shape)
    for joint, (_, parent) in enumerate((j.name, j.parent) for j in rig.joints):
        base = rest[joint] if parent < 0 else pose[:, parent] @ np.linalg.inv(rest[parent]) @ rest[joint]
        pose[:, joint] = base @ local[:, joint]
    return pose.astype(np.float32)


def good_recording(poses: int = 200, angles: np.ndarray | None = None, seed: int = 0) -> Recording:
    """A recording of the tube: random angles about X, a bulge of the joints' bends and of the control.

    Args:
        poses, seed: number of random poses and their seed.
        angles: (N, J) in place of random ones, radians.
    """
    rig, rng = good_rig(), np.random.default_rng(seed)
    if angles is None:
        angles = rng.uniform(-LIMIT, LIMIT, (poses, len(JOINTS)))
    controls = rng.uniform(0, 1, (len(angles), 1)).astype(np.float32)
    height = rig.rest_positions[:, 2] / BONE
    residuals = np.zeros((len(angles), rig.vertex_count, 3), np.float32)
    for joint in range(1, len(JOINTS)):
        near = np.exp(-(((height - joint) / 0.4) ** 2))
        residuals[:, :, 0] += 0.02 * np.sin(angles[:, joint, None]) ** 2 * near
    residuals[:, :, 1] += 0.01 * controls * np.exp(-((height - 1.5) ** 2))
    influencing = {j: tuple(i for i in (j, j + 1) if 0 < i < len(JOINTS)) for j in range(len(JOINTS))}
    partitions = make_partitions(rig, influencing, dict.fromkeys(range(len(JOINTS)), (0,)))
    channels = tuple(Channel(joint.name, "rotation", 0, -LIMIT, LIMIT) for joint in JOINTS)
    sampling = Sampling(seed, 1.0, channels, (Source("random", len(angles)),))
    info = RecordingInfo(len(angles), len(angles), "tube.blend", "tube", "5.2.0", sampling)
    matrices = pose_rig(rig, turns(angles))
    return Recording(Path("tube"), info, rig, partitions, matrices, residuals, controls)


def with_rig(recording: Recording, **changes: object) -> Recording:
    """The same poses and residuals of a changed rig."""
    rig = replace(recording.rig, **changes)
    return replace(recording, rig=rig)


def recorded_positions(recording: Recording, positions: np.ndarray) -> Recording:
    """The recording as it is when the rig evaluates to these (N, V, 3) positions."""
    skinning = LinearSkinning(recording.rig, recording.partitions)
    return replace(recording, residuals=skinning.local_residuals(recording.pose_matrices, positions))


def warned(recording: Recording) -> dict[str, str]:
    return {warning.name: warning.text for warning in check_recording(recording)}


def only(recording: Recording, name: str) -> str:
    """The text of the one warning of a recording."""
    found = warned(recording)
    assert list(found) == [name]
    return found[name]


def with_partitions(recording: Recording, **changes) -> Recording:
    return replace(recording, partitions=tuple(replace(p, **changes) for p in recording.partitions))
