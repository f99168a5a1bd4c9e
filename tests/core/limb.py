# SPDX-License-Identifier: GPL-3.0-or-later
"""A rig made without Blender, with random vertices on four joints in a branching hierarchy; and recordings of it."""

from pathlib import Path

import numpy as np

from fdda_addon.core.mathematics.partition import Partition, make_partitions
from fdda_addon.core.mathematics.poses import Channel
from fdda_addon.core.recording.index import RecordingInfo, Sampling, Source
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.core.rig import Fingerprint, Joint, MeshPart, Rig

JOINTS = (Joint("root", -1), Joint("upper", 0), Joint("lower", 1), Joint("thumb", 1))
VERTEX_COUNT = 40
INFLUENCING = {0: (1,), 1: (1, 2, 3), 2: (2,), 3: ()}
CHANNELS = (Channel("upper", "rotation", 0, -0.5, 1.5), Channel("root", "location", 2, -0.1, 0.1))


def random_rotations(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Return (..., 3, 3) float64 rotation matrices, uniformly distributed."""
    q, r = np.linalg.qr(rng.normal(size=(*shape, 3, 3)))
    q *= np.sign(np.diagonal(r, axis1=-2, axis2=-1))[..., None, :]
    q[np.linalg.det(q) < 0, :, 0] *= -1
    return q


def random_transforms(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Return (..., 4, 4) float64 transforms: any rotation, scales of 0.8 to 1.25, translations up to 1 m per axis."""
    matrices = np.zeros((*shape, 4, 4))
    matrices[..., :3, :3] = random_rotations(rng, *shape) * rng.uniform(0.8, 1.25, (*shape, 1, 1))
    matrices[..., :3, 3] = rng.uniform(-1, 1, (*shape, 3))
    matrices[..., 3, 3] = 1
    return matrices


def make_rig(seed: int = 0) -> Rig:
    """Return a rig with a partition for each of `JOINTS`; each of its vertices has weights on one to three joints."""
    rng = np.random.default_rng(seed)
    skin_joints = np.stack([rng.permutation(len(JOINTS)) for _ in range(VERTEX_COUNT)]).astype(np.int32)
    skin_weights = rng.uniform(0.1, 1, (VERTEX_COUNT, 4))
    # The first joint of a vertex has the largest weight. A quarter of the vertices follow one joint, none all four.
    skin_weights[:, 0] += 1
    skin_weights[: VERTEX_COUNT // 4, 1:] = 0
    skin_weights[:, 3] = 0
    skin_joints[skin_weights == 0] = 0
    skin_weights = (skin_weights / skin_weights.sum(axis=1, keepdims=True)).astype(np.float32)
    positions = rng.uniform(-0.5, 0.5, (VERTEX_COUNT, 3)).astype(np.float32)
    fingerprint = Fingerprint("limb", Fingerprint.digest(positions), Fingerprint.digest(skin_joints, skin_weights))
    meshes = (MeshPart("limb", len(positions), fingerprint),)
    rest_matrices = random_transforms(rng, len(JOINTS)).astype(np.float32)
    return Rig(JOINTS, positions, rest_matrices, skin_joints, skin_weights, meshes, *make_faces())


def make_faces() -> tuple[np.ndarray, np.ndarray]:
    """Return the starts and vertices of faces that are alternately triangles, quads and pentagons."""
    corner_counts = np.arange(VERTEX_COUNT // 4) % 3 + 3
    starts = np.cumsum(corner_counts) - corner_counts
    first_vertices = np.repeat(np.arange(len(corner_counts)) * 3, corner_counts)
    offsets = np.arange(corner_counts.sum()) - np.repeat(starts, corner_counts)
    return starts.astype(np.int32), (first_vertices + offsets).astype(np.int32)


def random_poses(count: int, seed: int = 1) -> np.ndarray:
    """Return (count, J, 4, 4) float32 pose matrices."""
    return random_transforms(np.random.default_rng(seed), count, len(JOINTS)).astype(np.float32)


def random_positions(count: int, seed: int = 2) -> np.ndarray:
    """Return (count, V, 3) float32 positions near the origin, or residuals of some millimeters."""
    return np.random.default_rng(seed).normal(0, 0.004, (count, VERTEX_COUNT, 3)).astype(np.float32)


def partitions_of(rig: Rig) -> tuple[Partition, ...]:
    """Return the partitions of the rig with the influencing joints of `INFLUENCING`."""
    return make_partitions(rig, INFLUENCING)


def recording_info(poses: int, seed: int = 0) -> RecordingInfo:
    """Return the header of a recording without poses yet: random poses, and two frames of an action."""
    sampling = Sampling(seed, 1.0, CHANNELS, (Source("random", poses - 2), Source("action", 2, "wave", (1, 1))))
    return RecordingInfo(poses, 0, "limb.blend", "5.2.0", sampling)


def record_limb(
    path: Path, poses: int = 12, complete: int | None = None, batch_size: int = 5, resume: bool = False
) -> Rig:
    """Record the limb in batches until `complete` poses are recorded, all when left out; return its rig."""
    rig = make_rig()
    matrices, residuals = random_poses(poses), random_positions(poses)
    end_pose = poses if complete is None else complete
    with RecordingWriter(path, rig, recording_info(poses), resume) as writer:
        while writer.complete < end_pose:
            batch_slice = slice(writer.complete, min(writer.complete + batch_size, end_pose))
            writer.append(matrices[batch_slice], residuals[batch_slice])
    return rig
