# SPDX-License-Identifier: GPL-3.0-or-later
"""Ranges of motion, and random poses inside them."""

from dataclasses import asdict, dataclass, replace

import numpy as np

from ..json_check import COUNT, NUMBER, Interval, check_json
from ..settings import SPREAD

ROTATION, ROTATION_VECTOR, LOCATION, SCALE, CONTROL = "rotation", "rotation_vector", "location", "scale", "control"
CHANNEL_KINDS = (ROTATION, ROTATION_VECTOR, LOCATION, SCALE, CONTROL)
"""All kinds of channels."""
DEFAULT_RANGE = (-np.pi / 4, np.pi / 4)
"""Range of a rotation axis that the rig neither limits nor locks, radians."""

OVERSHOOT_POSE_RATIO = 0.25
"""Ratio of the random poses that lie in the overshoot (`Overshoot`)."""
MAX_OVERSHOOT = 4.0
"""Largest scale of the range of motion; animators need no wider poses."""
LOCKED_AXIS_ANGLE = np.pi / 4
"""Largest rotation of a locked axis in the overshoot, radians, for each unit by which the factor exceeds 1."""
REST_STREAM = 2
"""Number that distinguishes the random stream of resting keys from the others of a pose."""
RANGE_TOLERANCE = 1e-4
"""Largest difference of two limits that count as equal, radians or meters. Blender stores them as float32."""


@dataclass(frozen=True)
class Channel:
    """One number of a pose, such as an angle or a location, that random poses vary.

    Attributes:
        name: name of the bone, or of the control (`Control.name`).
        kind: `ROTATION` (Euler angle, radians), `ROTATION_VECTOR` (one of three components of axis times angle,
            radians), `LOCATION` (meters) or `SCALE` (factor) of a bone, relative to the rest pose, or `CONTROL` (the
            unit of its property).
        axis: 0, 1 or 2; 0 for a control.
        low, high: the range of motion.
        is_key: it is a shape key, or belongs to a bone that acts through shape keys alone (`sample_pose`).
    """

    name: str
    kind: str
    axis: int
    low: float
    high: float
    is_key: bool = False

    @property
    def rest(self) -> float:
        """Value of the channel in the rest pose, clamped to the range."""
        return min(max(1.0 if self.kind == SCALE else 0.0, self.low), self.high)

    @property
    def can_change(self) -> bool:
        """Whether the range has values other than the value in the rest pose."""
        rest = 1.0 if self.kind == SCALE else 0.0
        return self.high - rest > RANGE_TOLERANCE or rest - self.low > RANGE_TOLERANCE

    def to_json(self) -> dict:
        """Return the JSON for a file. Its key for the name is `bone`, also for a control."""
        values = asdict(self)
        return {"bone": values.pop("name"), **values}

    @staticmethod
    def from_json(value: dict) -> "Channel":
        """Read a channel from a file.

        Raises:
            TypeError, ValueError: it is damaged.
        """
        kinds = {"kind": set(CHANNEL_KINDS), "axis": range(3), "is_key?": bool}
        check_json(value, {"bone": str, **kinds, "low": NUMBER, "high": NUMBER}, "its range of motion")
        values = dict(value)
        channel = Channel(values.pop("bone"), **values)
        if channel.low > channel.high or not channel.name:
            raise ValueError(f"its range of motion of {channel.name!r} is {channel.low} to {channel.high}")
        return channel


def sample_pose(channels: tuple[Channel, ...], seed: int, index: int, spread: float = SPREAD.default) -> np.ndarray:
    """Draw one pose from normal distributions around the centers of the ranges, truncated to the ranges.

    Each key moves with a probability that the pose draws from 0 to 1, and rests otherwise, because animation moves few
    of many keys at once. If there are only keys, at least one moves. The pose depends on channels, seed and index
    alone, so a resumed recording continues with the same poses.

    Args:
        channels: C channels with their ranges.
        seed: seed of the recording.
        index: index of the pose in the recording.
        spread: standard deviation as a ratio of half the range; larger values are closer to uniform.

    Returns:
        (C,) float64, each in the unit of its channel.
    """
    rng = np.random.default_rng([seed, index])
    low, high = np.array([channel.low for channel in channels]), np.array([channel.high for channel in channels])
    offsets = rng.standard_normal(len(channels)) * spread
    while len(outside := np.flatnonzero(np.abs(offsets) > 1)):
        offsets[outside] = rng.standard_normal(len(outside)) * spread
    # Rounding may lead to values slightly outside of the range.
    values = np.clip((low + high) / 2 + (high - low) / 2 * offsets, low, high)
    if keys := list(dict.fromkeys(channel.name for channel in channels if channel.is_key)):
        rng = np.random.default_rng([seed, index, REST_STREAM])
        probability, draws = rng.random(), rng.random(len(keys))
        if len(keys) == len({channel.name for channel in channels}):
            draws[draws.argmin()] = -1.0
        resting = {key for key, draw in zip(keys, draws, strict=True) if draw >= probability}
        values = np.array([c.rest if c.name in resting else value for c, value in zip(channels, values, strict=True)])
    return values


def widen_ranges(channels: tuple[Channel, ...], factor: float) -> tuple[Channel, ...]:
    """Widen the ranges of channels by a factor, around their centers."""
    widened = []
    for channel in channels:
        center, half_width = (channel.low + channel.high) / 2, (channel.high - channel.low) / 2 * factor
        widened.append(replace(channel, low=center - half_width, high=center + half_width))
    return tuple(widened)


@dataclass(frozen=True)
class Overshoot:
    """Random poses outside of the range of motion, for animation that exceeds the limits.

    Attributes:
        factor: scale of the range of motion from which these poses are drawn.
        poses: number of these poses, which are the last of the random poses.
        channels: channels of these poses, with scaled ranges: the channels of the other random poses, then the locked
            axes.
    """

    factor: float
    poses: int
    channels: tuple[Channel, ...]

    def to_json(self) -> dict:
        limits = [channel.to_json() for channel in self.channels]
        return {"factor": self.factor, "poses": self.poses, "limits": limits}

    @staticmethod
    def from_json(value: dict) -> "Overshoot":
        """Read an overshoot from a file.

        Raises:
            TypeError, ValueError: it is damaged.
        """
        check_json(value, {"factor": Interval(1, MAX_OVERSHOOT), "poses": COUNT, "limits": [{}]}, "its overshoot")
        channels = tuple(Channel.from_json(channel) for channel in value["limits"])
        return Overshoot(float(value["factor"]), value["poses"], channels)


def make_overshoot(
    channels: tuple[Channel, ...], locked: tuple[Channel, ...], factor: float, poses: int
) -> Overshoot | None:
    """Make the overshoot of random poses; None for a factor of 1 or too few poses.

    Controls keep their ranges, because their properties clamp them, and scales stay above zero.

    Args:
        channels: channels of the poses inside the range of motion.
        locked: locked rotation axes of the same bones, which the overshoot rotates (`LOCKED_AXIS_ANGLE`).
        factor: scale of the range of motion; 1 for no overshoot.
        poses: number of all random poses.
    """
    overshoot_poses = round(poses * OVERSHOOT_POSE_RATIO)
    if factor == 1 or not overshoot_poses:
        return None
    scaled_channels = []
    for channel, scaled_channel in zip(channels, widen_ranges(channels, factor), strict=True):
        if channel.kind == CONTROL:
            scaled_channel = channel
        elif channel.kind == SCALE:
            scaled_channel = replace(
                scaled_channel, low=max(scaled_channel.low, min(channel.low, channel.low / factor))
            )
        scaled_channels.append(scaled_channel)
    angle = LOCKED_AXIS_ANGLE * (factor - 1)
    return Overshoot(
        factor, overshoot_poses, (*scaled_channels, *(replace(axis, low=-angle, high=angle) for axis in locked))
    )


def bones_with_changed_range(before: tuple[Channel, ...], after: tuple[Channel, ...]) -> list[str]:
    """List the bones whose range of motion differs, in the order of `after`, with missing bones last."""

    def by_bone(channels: tuple[Channel, ...]) -> dict[str, dict[tuple[str, int], tuple[float, float]]]:
        ranges: dict[str, dict] = {}
        for channel in channels:
            ranges.setdefault(channel.name, {})[channel.kind, channel.axis] = (channel.low, channel.high)
        return ranges

    old_ranges, new_ranges = by_bone(before), by_bone(after)
    return [
        bone
        for bone in {**new_ranges, **old_ranges}
        if old_ranges.get(bone, {}).keys() != new_ranges.get(bone, {}).keys()
        or any(
            not np.allclose(old_ranges[bone][key], new_ranges[bone][key], atol=RANGE_TOLERANCE)
            for key in old_ranges[bone]
        )
    ]
