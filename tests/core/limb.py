# SPDX-License-Identifier: GPL-3.0-or-later
"""A rig without Blender: random vertices on four joints, one of which branches off; and recordings of it."""

from pathlib import Path

import numpy as np

from fdda_addon.core.partition import Partition, make_partitions
from fdda_addon.core.poses import Channel
from fdda_addon.core.recording.index import RecordingInfo, Sampling, Source
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.core.rig import Fingerprint, Joint, Rig

JOINTS = (Joint("root", -1), Joint("upper", 0), Joint("lower", 1), Joint("thumb", 1))
VERTICES = 40
INFLUENCING = {0: (1,), 1: (1, 2, 3), 2: (2,), 3: ()}
CHANNELS = (Channel("upper", "rotation", 0, -0.5, 1.5), Channel("root", "location", 2, -0.1, 0.1))


def random_rotations(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """(..., 3, 3) float64 rotations, uniformly distributed."""
    q, r = np.linalg.qr(rng.normal(size=(*shape, 3, 3)))
    q *= np.sign(np.diagonal(r, axis1=-2, axis2=-1))[..., None, :]
    q[np.linalg.det(q) < 0, :, 0] *= -1
    return q


def random_transforms(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """(..., 4, 4) float64: a rotation and a translation of up to a metre, a scale between 0.8 and 1.25."""
    matrices = np.zeros((*shape, 4, 4))
    matrices[..., :3, :3] = random_rotations(rng, *shape) * rng.uniform(0.8, 1.25, (*shape, 1, 1))
    matrices[..., :3, 3] = rng.uniform(-1, 1, (*shape, 3))
    matrices[..., 3, 3] = 1
    return matrices


def make_rig(seed: int = 0) -> Rig:
    """A rig of `JOINTS` and `VERTICES`: each vertex follows one to three joints, every joint has a partition."""
    rng = np.random.default_rng(seed)
    skin_joints = np.stack([rng.permutation(len(JOINTS)) for _ in range(VERTICES)]).astype(np.int32)
    skin_weights = rng.uniform(0.1, 1, (VERTICES, 4))
    # The first place is the heaviest; some vertices follow one joint alone, none follows all four.
    skin_weights[:, 0] += 1
    skin_weights[: VERTICES // 4, 1:] = 0
    skin_weights[:, 3] = 0
    skin_joints[skin_weights == 0] = 0
    skin_weights = (skin_weights / skin_weights.sum(axis=1, keepdims=True)).astype(np.float32)
    positions = rng.uniform(-0.5, 0.5, (VERTICES, 3)).astype(np.float32)
    fingerprint = Fingerprint("limb", Fingerprint.digest(positions), Fingerprint.digest(skin_joints, skin_weights))
    rest = random_transforms(rng, len(JOINTS)).astype(np.float32)
    return Rig(JOINTS, positions, rest, skin_joints, skin_weights, fingerprint, *make_faces())


def make_faces() -> tuple[np.ndarray, np.ndarray]:
    """Starts and vertices of triangles, quads and pentagons in turn, along the vertices."""
    corners = np.arange(VERTICES // 4) % 3 + 3
    starts = np.cumsum(corners) - corners
    first = np.repeat(np.arange(len(corners)) * 3, corners)
    return starts.astype(np.int32), (first + np.arange(corners.sum()) - np.repeat(starts, corners)).astype(np.int32)


def random_poses(count: int, seed: int = 1) -> np.ndarray:
    """(count, J, 4, 4) float32 pose matrices."""
    return random_transforms(np.random.default_rng(seed), count, len(JOINTS)).astype(np.float32)


def random_residuals(count: int, seed: int = 2) -> np.ndarray:
    """(count, V, 3) float32 local residuals of some millimetres."""
    return np.random.default_rng(seed).normal(0, 0.004, (count, VERTICES, 3)).astype(np.float32)


def partitions_of(rig: Rig) -> tuple[Partition, ...]:
    return make_partitions(rig, INFLUENCING)


def recording_info(poses: int, seed: int = 0) -> RecordingInfo:
    sampling = Sampling(seed, 1.0, CHANNELS, (Source("random", poses - 2), Source("action", 2, "wave", (1, 1))))
    return RecordingInfo(poses, 0, "limb.blend", "limb", "5.2.0", sampling)


def record_limb(path: Path, poses: int = 12, complete: int | None = None, batch: int = 5, resume: bool = False) -> Rig:
    """Record the limb in batches, from where the recording stands up to `complete` poses (all when left out)."""
    rig = make_rig()
    matrices, residuals = random_poses(poses), random_residuals(poses)
    end = poses if complete is None else complete
    with RecordingWriter(path, rig, partitions_of(rig), recording_info(poses), resume) as writer:
        while writer.complete < end:
            part = slice(writer.complete, min(writer.complete + batch, end))
            writer.append(matrices[part], residuals[part])
    return rig
