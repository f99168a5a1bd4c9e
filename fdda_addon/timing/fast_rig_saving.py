# SPDX-License-Identifier: GPL-3.0-or-later
"""What a fast rig would save in a frame."""

from dataclasses import asdict, dataclass

from .durations import Duration
from .rig_cost import estimate_playback_ms


@dataclass(frozen=True)
class FastRigSaving:
    """Times of a frame of a rig and of a copy without the bones, objects and modifiers that a fast rig removes.

    Attributes:
        vertices: number of vertices of the mesh that a model would deform.
        bones, kept_bones: number of bones of the rig, and of the copy.
        joints, controls: number of joints and of visible control bones that the copy keeps, with what they need.
        full: time with the rig.
        pruned: time with the copy, whose mesh has the Armature modifier alone, without a model.
    """

    vertices: int
    bones: int
    kept_bones: int
    joints: int
    controls: int
    full: Duration
    pruned: Duration

    @property
    def fast(self) -> float:
        """Return the estimated time of a frame with the fast rig and a model, ms."""
        return self.pruned.median + estimate_playback_ms(self.vertices)

    @property
    def sentence(self) -> str:
        """Return a sentence that says what a fast rig would save."""
        return (
            f"A fast rig with all visible controls ({self.controls:,}) and joints ({self.joints:,}) would keep "
            f"{self.kept_bones:,} of {self.bones:,} bones, and take about {self.fast:.2f} ms in place of "
            f"{self.full.median:.2f} ms ({self.full.median / self.fast:.1f} times as fast)."
        )

    def to_json(self) -> dict:
        """Return the saving as JSON, described in docs/formats.md."""
        durations = {"full": self.full.to_json(), "pruned": self.pruned.to_json()}
        return {**asdict(self), **durations, "fast": round(self.fast, 4)}

    @staticmethod
    def from_json(values: dict) -> "FastRigSaving":
        """Return the saving that `to_json` has written."""
        numbers = {key: values[key] for key in ("vertices", "bones", "kept_bones", "joints", "controls")}
        return FastRigSaving(**numbers, full=Duration(**values["full"]), pruned=Duration(**values["pruned"]))
