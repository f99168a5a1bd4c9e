# SPDX-License-Identifier: GPL-3.0-or-later
"""What a fast rig would save in a frame."""

from dataclasses import asdict, dataclass

from .durations import Duration


@dataclass(frozen=True)
class FastRigSaving:
    """Times of a frame of a rig, and of a fast rig of it with untrained models.

    Attributes:
        bones, kept_bones: number of bones of the rig, and of the fast rig.
        joints, controls: number of joints and of visible control bones that the fast rig keeps, with what they need.
        full: time with the rig.
        fast: time with the fast rig.
    """

    bones: int
    kept_bones: int
    joints: int
    controls: int
    full: Duration
    fast: Duration

    @property
    def ratio(self) -> float:
        """Return how many times faster a frame is with the fast rig."""
        return self.full.median / max(self.fast.median, 1e-9)

    def describe(self, frame_ms: float) -> str:
        """Return a sentence that says what a fast rig would save.

        Args:
            frame_ms: time of a frame with the rig, ms.
        """
        time_text = f"{frame_ms / self.ratio:.2f} ms in place of {frame_ms:.2f} ms ({self.ratio:.1f} times as fast)"
        if self.kept_bones == self.bones:
            return (
                f"A fast rig would keep all {self.bones:,} bones, because the visible controls ({self.controls:,}) and "
                f"joints ({self.joints:,}) need them: {time_text}, mostly by its models."
            )
        return (
            f"A fast rig with all visible controls ({self.controls:,}) and joints ({self.joints:,}) would keep "
            f"{self.kept_bones:,} of {self.bones:,} bones: {time_text}."
        )

    def to_json(self) -> dict:
        """Return the saving as JSON, described in docs/formats.md."""
        return {**asdict(self), "full": self.full.to_json(), "fast": self.fast.to_json()}

    @staticmethod
    def from_json(values: dict) -> "FastRigSaving":
        """Return the saving that `to_json` has written."""
        numbers = {key: values[key] for key in ("bones", "kept_bones", "joints", "controls")}
        return FastRigSaving(**numbers, full=Duration(**values["full"]), fast=Duration(**values["fast"]))
