# SPDX-License-Identifier: GPL-3.0-or-later
"""What `recording.json` says of a target: the object whose surface was recorded in place of the rig's own."""

import math
from dataclasses import dataclass

from ..rig import read_name

POSE, FRAMES, SIMULATION = "pose", "frames", "simulation"
"""What a target follows: the pose at once; the frame, as caches do; or the pose and what was before it."""
FOLLOWS = (POSE, FRAMES, SIMULATION)


@dataclass(frozen=True)
class RecordedTarget:
    """How the target of a recording was evaluated.

    Attributes:
        object_name: of the target.
        follows: `POSE`, `FRAMES` or `SIMULATION`.
        pre_roll: frames in which the rig went from the rest pose to the first frame of an action.
        settle: frames that a random pose was held for at most, 0 where poses were not held.
        still_mm: the target is at rest when no vertex moves by more from a frame to the next, mm.
    """

    object_name: str
    follows: str
    pre_roll: int = 0
    settle: int = 0
    still_mm: float = 0.0

    def to_json(self) -> dict:
        settled = {"settle": self.settle, "still_mm": self.still_mm} if self.settle else {}
        return {"object": self.object_name, "follows": self.follows, "pre_roll": self.pre_roll, **settled}

    @staticmethod
    def from_json(value: dict) -> "RecordedTarget":
        """ValueError, TypeError or KeyError where it is damaged."""
        target = RecordedTarget(
            read_name(value["object"]),
            value["follows"],
            value["pre_roll"],
            value.get("settle", 0),
            value.get("still_mm", 0.0),
        )
        if target.follows not in FOLLOWS:
            raise ValueError(f"its target follows {target.follows!r}")
        for number in (target.pre_roll, target.settle):
            if type(number) is not int or number < 0:
                raise ValueError(f"its target has {number!r} frames")
        if type(target.still_mm) not in (int, float) or not 0 <= target.still_mm < math.inf:
            raise ValueError(f"its target rests below {target.still_mm!r} mm")
        return target
