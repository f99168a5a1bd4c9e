# SPDX-License-Identifier: GPL-3.0-or-later
"""A part of a recording: some of the poses of its plan, so that machines can record them at the same time."""

from dataclasses import dataclass

MAX_SHARDS = 100_000


@dataclass(frozen=True)
class Shard:
    """Which poses of a plan a recording has: `first` and those that follow, as many as its index says.

    Attributes:
        first: number of the first pose.
        total: how many poses the plan has.
    """

    first: int
    total: int

    @staticmethod
    def from_json(value: dict, poses: int) -> "Shard":
        """What `to_json` gave, of a recording of some poses.

        Raises:
            ValueError: the counts contradict each other.
            KeyError, TypeError: it is damaged.
        """
        first, total = value["first"], value["of"]
        if type(first) is not int or type(total) is not int or not 0 <= first <= first + poses <= total:
            raise ValueError(f"poses {first!r} and {poses} that follow are no part of {total!r}")
        return Shard(first, total)

    def to_json(self) -> dict:
        return {"first": self.first, "of": self.total}

    def in_words(self, poses: int) -> str:
        """ "poses 250 to 499 of 1,000", and what a shard without poses is there for."""
        if not poses:
            return f"influences for {self.total:,} poses, and none of these"
        return f"poses {self.first:,} to {self.first + poses - 1:,} of {self.total:,}"


def shard_poses(number: int, count: int, total: int) -> range:
    """Numbers of the poses that belong to a shard; all shards together have each pose once.

    Args:
        number: of the shard, 1 to `count`.
        count: how many shards there are.
        total: how many poses.
    """
    return range((number - 1) * total // count, number * total // count)
