# SPDX-License-Identifier: GPL-3.0-or-later
"""Turn matrices: what residuals are fitted to, beside skin matrices, where a rig preserves volume.

Such a rig blends rotations, so what lies half-way between a joint and its parent turns half as far. No sum of the
matrices of the two does: it goes with the sine of half the angle, as turn matrices nearly do, and these take no root.
Blending of rotations: Kavan and others, Geometric Skinning with Approximate Dual Quaternion Blending, 2008.
"""

from collections.abc import Callable

import numpy as np

from fdda_addon.core.features import joint_features
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.rig import Rig
from fdda_addon.core.skinning import skin_matrices

from .joint_fit import surroundings_of_rig
from .process import Cancelled

LEAST_DIVISOR = 1.0
"""Of a turn matrix; that of a rotation is 2 at least."""
MOST_POSES, MOST_VERTICES = 800, 64
"""So many of the training poses, and so many vertices of each partition, say whether turn matrices help."""
HELPFUL = 0.7
"""They help when the fit leaves less than this part of the squared residuals that it leaves without them."""


def turn_matrices(pose_matrices: np.ndarray, rig: Rig) -> np.ndarray:
    """Turn matrices V_j = Q_j A_j B_j^-1, with A_j = (R_j - R_j^T) / (3 + tr R_j).

    Q_j is the joint as its parent carries it, P_p B_p^-1 B_j, and R_j how it turns and scales against that, the upper
    left of F_j in `core.features`. Where R_j turns by an angle a, A_j = sin a / (2 + cos a) [axis]x, which is within
    three hundredths of 0.687 sin (a/2) up to 120 degrees, and 0 at 0 and at 180.

    Args:
        pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.

    Returns:
        (N, J, 3, 3) float64, no unit; zero for roots, which turn against nothing.
    """
    joints = len(rig.parents)
    turned = joint_features(pose_matrices, rig.rest_matrices, rig.parents).reshape(-1, joints, 3, 4)[..., :3]
    turned = turned.astype(np.float64)
    divisor = np.maximum(3 + np.trace(turned, axis1=2, axis2=3), LEAST_DIVISOR)
    turned = (turned - turned.swapaxes(2, 3)) / divisor[..., None, None]
    rest = rig.rest_matrices[:, :3, :3].astype(np.float64)
    carried = skin_matrices(pose_matrices, rig.rest_matrices)[:, np.maximum(rig.parents, 0), :3, :3]
    return np.where((rig.parents < 0)[:, None, None], 0, carried @ (rest @ turned @ np.linalg.inv(rest)))


def fit_matrices(pose_matrices: np.ndarray, rig: Rig, turns: bool) -> np.ndarray:
    """The matrices that residuals are fitted to.

    Args:
        pose_matrices: (N, J, 4, 4), mesh-object space, mesh units.
        turns: whether there are turn matrices among them.

    Returns:
        (N, J, 3, 4) float32 skin matrices, mesh units, or (N, 2 J, 3, 4): behind them the turn matrices, which move
        nothing along.
    """
    skin = skin_matrices(pose_matrices, rig.rest_matrices)[:, :, :3]
    if not turns:
        return skin
    turned = np.pad(turn_matrices(pose_matrices, rig), ((0, 0), (0, 0), (0, 0), (0, 1)))
    return np.concatenate([skin, turned.astype(np.float32)], axis=1)


def turns_help(recording: Recording, training: np.ndarray, should_stop: Callable[[], bool] = lambda: False) -> bool:
    """Whether turn matrices leave so much less of the residuals that they are worth their nodes in the graph.

    Args:
        recording: of the rig.
        training: (n,) indices of the poses that train; half of those that are looked at are fitted to, on the other
            half is measured.

    Raises:
        Cancelled: `should_stop` said so.
    """
    rig = recording.rig
    poses = training[:: -(-len(training) // MOST_POSES)]
    fitted, measured = np.arange(0, len(poses), 2), np.arange(1, len(poses), 2)
    pose_matrices = np.array(recording.pose_matrices[poses])
    without, with_turns = (fit_matrices(pose_matrices, rig, turns) for turns in (False, True))
    left = np.zeros(2)
    for partition in recording.partitions:
        if should_stop():
            raise Cancelled
        vertices = partition.vertices[:: -(-len(partition.vertices) // MOST_VERTICES)]
        residuals = np.array(recording.residuals[poses[:, None], vertices])
        for number, matrices in enumerate((without, with_turns)):
            _, rest = surroundings_of_rig(rig, partition, matrices).fit(residuals, fitted)
            left[number] += len(partition.vertices) * float((rest[measured].astype(np.float64) ** 2).mean())
    return bool(left[1] < HELPFUL * left[0])
