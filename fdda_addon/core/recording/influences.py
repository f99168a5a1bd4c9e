# SPDX-License-Identifier: GPL-3.0-or-later
"""Detects the joints and controls that influence each partition (Bailey et al. 2018, section 3.3).

The recording has poses in which one input is moved alone, from the rest pose and from random poses.
"""

from dataclasses import replace

import numpy as np

from ..mathematics.features import FLOAT32_ROUNDING_RATIO
from ..mathematics.partition import Partition
from ..mathematics.poses import CONTROL
from ..mathematics.skinning import LinearSkinning
from ..rig import STATIC_JOINT_LABEL, Rig
from ..sentences.counts import format_count
from .index import JOINT
from .reader import Recording

BATCH_BYTES = 6 << 20
"""Bytes of the positions of the poses whose residuals are computed together."""


def detect_influences(
    recording: Recording, rig: Rig, joints: np.ndarray, partitions: tuple[Partition, ...], tolerance: float
) -> tuple[np.ndarray, str]:
    """Detect which inputs of the recording change the residuals of which partitions.

    Args:
        recording: a recording with J joints, C controls and poses in which an input moves alone.
        rig: the rig with K of the joints and the skin weights of linear skinning.
        joints: (K,) indices of these joints in the recording.
        partitions: P partitions of `rig`.
        tolerance: an input influences a partition when it changes a residual by more than this ratio of the rig's size.

    Returns:
        (P, J + C) bool, and a note about positions that are not finite; empty if there are none.
    """
    alone, joint_count = recording.info.alone, len(recording.rig.joints)
    skinning = LinearSkinning(rig, partitions)
    # Far from the origin, rounding moves vertices, so the threshold must be larger.
    rounding = FLOAT32_ROUNDING_RATIO * float(np.abs(rig.rest_positions).max())
    threshold = max(tolerance * rig.size, 2 * rounding)
    batch_size = max(1, BATCH_BYTES // (12 * rig.vertex_count))
    influences = np.zeros((len(partitions), joint_count + len(rig.controls)), bool)
    influences[:, [joint_count + control for control in alone.undetectable]] = True
    infinite_tests = []

    def residuals(poses: slice) -> np.ndarray:
        matrices = np.array(recording.pose_matrices[poses])[:, joints]
        return skinning.local_residuals(matrices, np.array(recording.positions[poses]))

    # Base pose, first moved pose, and moved inputs of each run.
    stride = len(alone.inputs) + 1
    runs = [(base * stride, base * stride + 1, alone.inputs) for base in range(alone.bases)]
    runs.append((0, alone.first_key_pose, tuple((CONTROL, (key,)) for key in alone.keys)))
    offset = recording.info.alone_poses.start
    for base_index, (base_pose, moved_pose, inputs) in enumerate(runs):
        with np.errstate(invalid="ignore", over="ignore"):
            base = residuals(slice(offset + base_pose, offset + base_pose + 1))
            for start in range(0, len(inputs), batch_size):
                batch, first_pose = inputs[start : start + batch_size], offset + moved_pose + start
                norms = np.linalg.norm(residuals(slice(first_pose, first_pose + len(batch))) - base, axis=2)
                # A position that stops being finite is influenced; one that is not finite in the base pose is unknown.
                is_infinite = ~np.isfinite(norms) & np.isfinite(base).all(axis=2)
                infinite_tests += [
                    (base_index % alone.bases, *batch[index]) for index in np.flatnonzero(is_infinite.any(axis=1))
                ]
                is_changed = (norms > threshold) | is_infinite
                for index, partition in enumerate(partitions):
                    for number in np.flatnonzero(is_changed[:, partition.vertices].any(axis=1)):
                        kind, indices = batch[number]
                        influences[index, [i if kind == JOINT else joint_count + i for i in indices]] = True
    if not infinite_tests:
        return influences, ""
    base_index, kind, indices = infinite_tests[0]
    base_text = f"random pose {base_index}" if base_index else "the rest pose"
    name = recording.rig.joint_names[indices[0]] if kind == JOINT else rig.controls[indices[0]].name
    count_text = format_count(len(infinite_tests), "test")
    return influences, (
        f"Some positions of the rig are not finite in {count_text} of its influences, as when "
        f"'{name or STATIC_JOINT_LABEL}' moves from {base_text}; that counts as an influence. Look for a constraint, "
        "driver or modifier that fails in extreme poses."
    )


def add_influences(partition: Partition, needed_inputs: np.ndarray, joint_count: int) -> Partition:
    """Return a partition with the inputs of a (J + C,) bool array added to its influences; `joint_count` is J."""
    joints, controls = np.flatnonzero(needed_inputs[:joint_count]), np.flatnonzero(needed_inputs[joint_count:])
    return replace(
        partition,
        influencing=tuple(sorted({*partition.influencing, *joints.tolist()})),
        controls=tuple(sorted({*partition.controls, *controls.tolist()})),
    )
