# SPDX-License-Identifier: GPL-3.0-or-later
"""Poses that combine limbs from different frames of actions.

The rotations of a limb belong together, as in real animation. The limbs are independent of each other, so that a model
does not learn that both arms swing in step. A little noise reaches what lies between and beyond the frames. Every
second pose is a plain random pose in the ranges of the same channels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .poses import CONTROL, ROTATION_VECTOR, Channel, sample_pose
from .rotations import multiply_quaternions, to_quaternions, to_rotation_vectors

NOISE_RADIANS = 0.2
"""Standard deviation of the noise about each free axis of a bone, radians (docs/experiments.md)."""
REMIX_STREAM = 1
"""Number that distinguishes the random stream of frames and noise from those of `sample_pose`."""


def find_limbs(parents: Sequence[int]) -> np.ndarray:
    """Divide bones into limbs: chains that begin at a root or after a branching bone.

    Args:
        parents: index of the parent of each of B bones, -1 for a root; parents come before their children.

    Returns:
        (B,) int64, index of the limb of each bone.
    """
    child_counts = np.bincount([parent for parent in parents if parent >= 0], minlength=len(parents))
    limbs = np.empty(len(parents), np.int64)
    limb_count = 0
    for bone, parent in enumerate(parents):
        if parent >= 0 and child_counts[parent] == 1:
            limbs[bone] = limbs[parent]
        else:
            limbs[bone], limb_count = limb_count, limb_count + 1
    return limbs


@dataclass(frozen=True, eq=False)
class Remix:
    """Frames of actions, and which channels belong together.

    Attributes:
        channels: C channels; the three channels of a rotation vector follow each other.
        values: (F, C) float64, value of each channel in each frame, in the unit of the channel.
        limbs: (C,) int64, index of the limb of each channel.
        has_noise: (C,) bool, the channels of rotation vectors whose axes get noise.
    """

    channels: tuple[Channel, ...]
    values: np.ndarray
    limbs: np.ndarray
    has_noise: np.ndarray

    def draw_pose(self, seed: int, index: int, noise_radians: float = NOISE_RADIANS) -> np.ndarray:
        """Draw a pose, which depends on seed and index alone.

        Args:
            seed: seed of the recording.
            index: index of the pose in the recording.
            noise_radians: standard deviation of the noise about each axis, radians.

        Returns:
            (C,) float64, each in the unit of its channel.
        """
        rng = np.random.default_rng([seed, index, REMIX_STREAM])
        frames = rng.integers(0, len(self.values), self.limbs.max(initial=-1) + 1)
        values = self.values[frames[self.limbs], np.arange(len(self.channels))]
        first_axes = [n for n, c in enumerate(self.channels) if c.kind == ROTATION_VECTOR and c.axis == 0]
        vector_columns = np.array(first_axes, np.intp)[:, None] + np.arange(3)
        noise = rng.normal(0, noise_radians, vector_columns.shape) * self.has_noise[vector_columns]
        rotations = multiply_quaternions(to_quaternions(values[vector_columns]), to_quaternions(noise))
        values[vector_columns] = to_rotation_vectors(rotations)
        return values


@dataclass(frozen=True)
class PoseSampler:
    """Draws the random poses of a recording.

    Attributes:
        seed, spread: as for `sample_pose`.
        remix: the frames whose limbs are combined; None for poses in the ranges of motion.
    """

    seed: int
    spread: float
    remix: Remix | None = None

    def draw_pose(self, channels: tuple[Channel, ...], index: int) -> np.ndarray:
        """Draw a pose. Channels that are not remixed, and those of every second pose, are drawn from their ranges.

        Args:
            channels: C channels.
            index: index of the pose in the recording.

        Returns:
            (C,) float64, each in the unit of its channel.
        """
        values = sample_pose(channels, self.seed, index, self.spread)
        if self.remix is not None and index % 2 == 0:
            remixed_values = dict(
                zip(map(_key, self.remix.channels), self.remix.draw_pose(self.seed, index), strict=True)
            )
            values = np.array(
                [remixed_values.get(_key(channel), value) for channel, value in zip(channels, values, strict=True)]
            )
        return values


def _key(channel: Channel) -> tuple[str, str, int]:
    """Identify a channel without its range."""
    return channel.name, channel.kind, channel.axis


def replace_bone_channels(channels: Sequence[Channel], remixed: Sequence[Channel]) -> tuple[Channel, ...]:
    """Return channels in which bones with remixed channels have these alone; controls keep their channels."""
    bone_channels = [channel for channel in remixed if channel.kind != CONTROL]
    names = {channel.name for channel in bone_channels}
    return (*(channel for channel in channels if channel.name not in names), *bone_channels)
