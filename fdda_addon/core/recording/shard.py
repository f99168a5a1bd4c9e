# SPDX-License-Identifier: GPL-3.0-or-later
"""Shards of a recording: ranges of its poses, which several machines can record at the same time."""

from dataclasses import dataclass

MAX_SHARDS = 100_000


@dataclass(frozen=True)
class Shard:
    """Range of the poses of a shard. The length of the range is the number of poses in the index of the shard.

    Attributes:
        first: index of the first pose.
        total: number of poses of all shards together.
    """

    first: int
    total: int

    @staticmethod
    def from_json(value: dict, poses: int) -> "Shard":
        """Read the JSON of `to_json` for a shard of `poses` poses.

        Raises:
            ValueError: the counts contradict each other.
            KeyError, TypeError: the JSON is damaged.
        """
        first, total = value["first"], value["of"]
        if type(first) is not int or type(total) is not int or not 0 <= first <= first + poses <= total:
            raise ValueError(f"poses {first!r} and {poses} that follow are no part of {total!r}")
        return Shard(first, total)

    def to_json(self) -> dict:
        return {"first": self.first, "of": self.total}

    def format_range(self, poses: int) -> str:
        """Format the range: "poses 250 to 499 of 1,000". A shard without poses has influences only."""
        if not poses:
            return f"influences for {self.total:,} poses, and none of these"
        return f"poses {self.first:,} to {self.first + poses - 1:,} of {self.total:,}"


def shard_poses(number: int, count: int, total: int) -> range:
    """Return the indices of the poses of a shard; each pose is in exactly one shard.

    Args:
        number: number of the shard, 1 to `count`.
        count: number of shards.
        total: number of poses of all shards together.
    """
    return range((number - 1) * total // count, number * total // count)
