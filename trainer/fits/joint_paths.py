# SPDX-License-Identifier: GPL-3.0-or-later
"""The joints between two joints of a rig."""

import numpy as np

from fdda_addon.core.rig import STATIC_JOINT, Rig


def static_joints(rig: Rig) -> frozenset[int]:
    """Return the joints of a rig that never move; they influence nothing."""
    return frozenset(index for index, joint in enumerate(rig.joints) if joint.name == STATIC_JOINT)


def joints_on_path(parents: np.ndarray, first: int, second: int) -> set[int]:
    """Return the joints whose parent-relative transforms compose the transform of one joint relative to another.

    Without a common ancestor, these are all joints from either one up to its root.
    """
    return set(_chain_to_root(parents, first)) ^ set(_chain_to_root(parents, second))


def _chain_to_root(parents: np.ndarray, joint: int) -> list[int]:
    chain = []
    while joint >= 0:
        chain.append(joint)
        joint = int(parents[joint])
    return chain
