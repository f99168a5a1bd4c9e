# SPDX-License-Identifier: GPL-3.0-or-later
"""Targets in `recording.json`: objects whose surface is recorded in place of the surface of the rig."""

import math
from dataclasses import dataclass

from ..rig import read_name
from ..sentences.counts import format_count

STATISTIC_NAMES = ("mean", "rms", "p99", "p999", "max")
POSE, FRAMES, SIMULATION = "pose", "frames", "simulation"
"""The dependence of a target: on the pose alone; on the frame, as a cache; or on the pose and earlier poses, as a
simulation."""
FOLLOWS_VALUES = (POSE, FRAMES, SIMULATION)


@dataclass(frozen=True)
class RecordedTarget:
    """How the target of a recording was evaluated.

    Attributes:
        object_name: name of the target object.
        follows: `POSE`, `FRAMES` or `SIMULATION`.
        pre_roll: number of frames in which the rig moved from the rest pose to the first frame of an action.
        settle_frames: largest number of frames for which a random pose was held; 0 where poses were not held.
        rest_threshold_mm: the target is at rest when no vertex moves by more than this between two frames, mm.
    """

    object_name: str
    follows: str
    pre_roll: int = 0
    settle_frames: int = 0
    rest_threshold_mm: float = 0.0

    def to_json(self) -> dict:
        settle_values = (
            {"settle_frames": self.settle_frames, "rest_threshold_mm": self.rest_threshold_mm}
            if self.settle_frames
            else {}
        )
        return {"object": self.object_name, "follows": self.follows, "pre_roll": self.pre_roll, **settle_values}

    @staticmethod
    def from_json(value: dict) -> "RecordedTarget":
        """Read a target from a file; raise ValueError, TypeError or KeyError where it is damaged."""
        target = RecordedTarget(
            read_name(value["object"]),
            value["follows"],
            value["pre_roll"],
            value.get("settle_frames", 0),
            value.get("rest_threshold_mm", 0.0),
        )
        if target.follows not in FOLLOWS_VALUES:
            raise ValueError(f"its target follows {target.follows!r}")
        for frame_count in (target.pre_roll, target.settle_frames):
            if type(frame_count) is not int or frame_count < 0:
                raise ValueError(f"its target has {frame_count!r} frames")
        if type(target.rest_threshold_mm) not in (int, float) or not 0 <= target.rest_threshold_mm < math.inf:
            raise ValueError(f"its target rests below {target.rest_threshold_mm!r} mm")
        return target


@dataclass(frozen=True)
class Repeatability:
    """Distance between the two shapes of a target in a pose that is reached from two directions.

    No model can have a smaller error.

    Attributes:
        poses: indices of the poses.
        distance_mm: distance of the vertices by name of a statistic: mean, rms, p99, p999 (99.9 %) and max, mm.
    """

    poses: tuple[int, ...]
    distance_mm: dict[str, float]

    def to_json(self) -> dict:
        return {"poses": list(self.poses), "distance_mm": self.distance_mm}

    @staticmethod
    def from_json(value: dict, poses: int) -> "Repeatability":
        """Read a repeatability from a file; raise ValueError, TypeError or KeyError where it is damaged.

        Args:
            value: the JSON.
            poses: number of poses of the recording.
        """
        repeatability = Repeatability(
            tuple(value["poses"]), {name: value["distance_mm"][name] for name in STATISTIC_NAMES}
        )
        if not repeatability.poses or not all(type(pose) is int and 0 <= pose < poses for pose in repeatability.poses):
            raise ValueError("its repeated poses are none of its poses")
        for distance in repeatability.distance_mm.values():
            if type(distance) not in (int, float) or not 0 <= distance < math.inf:
                raise ValueError(f"repeated poses are {distance!r} mm apart")
        return repeatability

    def sentence(self) -> str:
        """Return a text about how closely a repeated pose gives the same surface."""
        count = format_count(len(self.poses), "pose")
        return (
            f"The same pose from two directions: {self.distance_mm['mean']:.3g} mm apart on average, "
            f"{self.distance_mm['max']:.3g} mm at most ({count}). No model can be closer than that."
        )
