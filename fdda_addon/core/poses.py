# SPDX-License-Identifier: GPL-3.0-or-later
"""Ranges of motion, and random poses inside them."""

from dataclasses import asdict, dataclass, replace

import numpy as np

from .defaults import SPREAD

ROTATION, ROTATION_VECTOR, LOCATION, SCALE, CONTROL = "rotation", "rotation_vector", "location", "scale", "control"
KINDS = (ROTATION, ROTATION_VECTOR, LOCATION, SCALE, CONTROL)
"""Kinds of channels."""
DEFAULT_RANGE = (-np.pi / 4, np.pi / 4)
"""Range of a rotation axis that the rig neither limits nor locks, radians."""

MAX_CHANNEL_NAME_LENGTH = 2100
"""Letters of what a channel is called in a file: a control has an owner and a path."""
MARGIN_POSE_RATIO = 0.25
"""Part of the random poses that lies in the margin, where there is one."""
MAX_MARGIN = 4.0
"""Wider is no pose of anybody."""
LOCKED_AXIS_ANGLE = np.pi / 4
"""How far a locked axis turns in the margin, radians: by this for every range that the margin adds to a range."""
RANGE_TOLERANCE = 1e-4
"""Radians or metres. Ranges that differ by less count as the same: Blender keeps them as float32."""


@dataclass(frozen=True)
class Channel:
    """One number of a pose that may be sampled.

    Attributes:
        name: of the bone, or of the control (`Control.name`).
        kind: `ROTATION` (Euler angle, radians), `ROTATION_VECTOR` (one of three components of axis times angle,
            radians), `LOCATION` (metres) or `SCALE` (factor) of a bone, relative to the rest pose, or `CONTROL` (the
            unit of its property).
        axis: 0, 1 or 2; 0 for a control.
        low, high: the range of motion.
    """

    name: str
    kind: str
    axis: int
    low: float
    high: float

    @property
    def rest(self) -> float:
        """The value of the rest pose, or what comes nearest to it in the range."""
        return min(max(1.0 if self.kind == SCALE else 0.0, self.low), self.high)

    @property
    def changes(self) -> bool:
        """Whether the channel ever is elsewhere than in the rest pose."""
        rest = 1.0 if self.kind == SCALE else 0.0
        return self.high - rest > RANGE_TOLERANCE or rest - self.low > RANGE_TOLERANCE

    def to_json(self) -> dict:
        """As files have it: there the name is called `bone`, also that of a control."""
        values = asdict(self)
        return {"bone": values.pop("name"), **values}

    @staticmethod
    def from_json(value: dict) -> "Channel":
        """Read a channel from a file.

        Raises:
            KeyError, TypeError, ValueError: it is damaged.
        """
        values = dict(value)
        channel = Channel(values.pop("bone"), **values)
        if not isinstance(channel.name, str) or not 0 < len(channel.name) <= MAX_CHANNEL_NAME_LENGTH:
            raise ValueError(f"its range of motion is of a bone called {channel.name!r}")
        if channel.kind not in KINDS or type(channel.axis) is not int or channel.axis not in range(3):
            raise ValueError(f"its range of motion of {channel.name!r} is of {channel.kind!r}, axis {channel.axis!r}")
        for end in (channel.low, channel.high):
            if type(end) not in (int, float) or not np.isfinite(float(end)):
                raise ValueError(f"its range of motion of {channel.name!r} ends at {end!r}")
        if channel.low > channel.high:
            raise ValueError(f"its range of motion of {channel.name!r} is {channel.low} to {channel.high}")
        return channel


def sample_pose(channels: tuple[Channel, ...], seed: int, index: int, spread: float = SPREAD) -> np.ndarray:
    """Draw one pose: a normal distribution centred on the middle of each range, redrawn until inside.

    The pose depends on seed and index alone, so a recording that is resumed continues with the same poses.

    Args:
        channels: C channels with their ranges.
        seed: of the recording.
        index: of the pose in the recording.
        spread: standard deviation as a part of half the range; larger is closer to uniform.

    Returns:
        (C,) float64, radians or metres, as the channels say.
    """
    rng = np.random.default_rng([seed, index])
    low, high = np.array([(channel.low, channel.high) for channel in channels]).T
    places = rng.standard_normal(len(channels)) * spread
    while len(outside := np.flatnonzero(np.abs(places) > 1)):
        places[outside] = rng.standard_normal(len(outside)) * spread
    # Rounding must not lead out of the range.
    return np.clip((low + high) / 2 + (high - low) / 2 * places, low, high)


def scale_ranges(channels: tuple[Channel, ...], factor: float) -> tuple[Channel, ...]:
    """Channels whose ranges are `factor` times as wide, about the same middle."""
    widened = []
    for channel in channels:
        middle, half = (channel.low + channel.high) / 2, (channel.high - channel.low) / 2 * factor
        widened.append(replace(channel, low=middle - half, high=middle + half))
    return tuple(widened)


@dataclass(frozen=True)
class Margin:
    """Poses around the range of motion: what a model is to know of where an animator breaks the limits.

    Attributes:
        factor: how many times as wide as the range of motion they are drawn.
        poses: how many of the random poses, the last ones.
        channels: of these poses, with the widened ranges; those of the other poses first, then the locked axes.
    """

    factor: float
    poses: int
    channels: tuple[Channel, ...]

    def to_json(self) -> dict:
        limits = [channel.to_json() for channel in self.channels]
        return {"factor": self.factor, "poses": self.poses, "limits": limits}

    @staticmethod
    def from_json(value: dict) -> "Margin":
        """Read it from a file.

        Raises:
            KeyError, TypeError, ValueError: it is damaged.
        """
        factor, poses = value["factor"], value["poses"]
        if type(factor) not in (int, float) or not 1 < factor <= MAX_MARGIN:
            raise ValueError(f"its margin is {factor!r} times the range")
        if type(poses) is not int or poses < 0:
            raise ValueError(f"its margin has {poses!r} poses")
        if not isinstance(value["limits"], list):
            raise TypeError("the limits of its margin are no list")
        return Margin(float(factor), poses, tuple(Channel.from_json(channel) for channel in value["limits"]))


def make_margin(channels: tuple[Channel, ...], locked: tuple[Channel, ...], factor: float, poses: int) -> Margin | None:
    """The margin of random poses; None where there is none.

    Controls keep their ranges, which their properties hold them to, and scales stay above zero.

    Args:
        channels: of the poses inside the range of motion.
        locked: axes of the same bones that do not turn there (`LOCKED_AXIS_ANGLE`), whatever their ranges say.
        factor: how many times as wide as the range the margin is; 1 for none.
        poses: how many random poses there are in all.
    """
    count = round(poses * MARGIN_POSE_RATIO)
    if factor == 1 or not count:
        return None
    widened = []
    for own, wide in zip(channels, scale_ranges(channels, factor), strict=True):
        if own.kind == CONTROL:
            wide = own
        elif own.kind == SCALE:
            wide = replace(wide, low=max(wide.low, min(own.low, own.low / factor)))
        widened.append(wide)
    turn = LOCKED_AXIS_ANGLE * (factor - 1)
    return Margin(factor, count, (*widened, *(replace(channel, low=-turn, high=turn) for channel in locked)))


def bones_with_changed_range(before: tuple[Channel, ...], after: tuple[Channel, ...]) -> list[str]:
    """Names of the bones whose range of motion differs, in the order of `after`, those that are gone last."""

    def by_bone(channels: tuple[Channel, ...]) -> dict[str, dict[tuple[str, int], tuple[float, float]]]:
        found: dict[str, dict] = {}
        for channel in channels:
            found.setdefault(channel.name, {})[channel.kind, channel.axis] = (channel.low, channel.high)
        return found

    old, new = by_bone(before), by_bone(after)
    return [
        bone
        for bone in {**new, **old}
        if old.get(bone, {}).keys() != new.get(bone, {}).keys()
        or any(not np.allclose(own, new[bone][key], atol=RANGE_TOLERANCE) for key, own in old[bone].items())
    ]
