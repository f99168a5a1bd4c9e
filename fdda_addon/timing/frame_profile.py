# SPDX-License-Identifier: GPL-3.0-or-later
"""The profile of a frame: how much time its parts take, and what a model and a fast rig would save."""

import os
import platform
from dataclasses import asdict, dataclass

import bpy

from .benchmark import RIG, Benchmark
from .durations import Duration

ROUNDS = 5
"""Number of rounds. Each round measures every part."""
BONES, MODIFIER, SHAPE_KEYS, KEY_DRIVERS = "bones", "modifier", "shape_keys", "key_drivers"
REST, DRAWING = "rest", "drawing"
"""Kinds of the parts of a frame."""
BAR_WIDTH = 60
"""Number of characters of the bar that `FrameProfile.table` prints."""


@dataclass(frozen=True)
class FramePart:
    """A part of a frame.

    Attributes:
        kind: `BONES`, `MODIFIER`, `SHAPE_KEYS`, `KEY_DRIVERS` (which a model keeps), `REST` or `DRAWING`.
        object: name of the object that has the bones, the modifier or the shape keys; else empty.
        name: name of the modifier; else empty.
        duration: the time of the part.
    """

    kind: str
    object: str
    name: str
    duration: Duration

    @property
    def title(self) -> str:
        """Return the name of the part for users."""
        titles = {
            BONES: f"Bones of {self.object}", SHAPE_KEYS: f"{self.object}: Shape Keys",
            KEY_DRIVERS: f"{self.object}: Drivers of Shape Keys",
            MODIFIER: f"{self.object}: {self.name}", REST: "Rest of Evaluation", DRAWING: "Drawing",
        }  # fmt: skip
        return titles[self.kind]


@dataclass(frozen=True)
class FastRigSaving:
    """Times of a frame of a rig, and of a fast rig of it with untrained models.

    Attributes:
        bones, kept_bones: number of bones of the rig, and of the fast rig.
        joints, controls: number of joints and of visible control bones that the fast rig keeps, with what they need.
        full, fast: median times with the rig and with the fast rig, ms.
    """

    bones: int
    kept_bones: int
    joints: int
    controls: int
    full: float
    fast: float

    @property
    def ratio(self) -> float:
        """Return how many times faster a frame is with the fast rig."""
        return self.full / max(self.fast, 1e-9)

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


@dataclass(frozen=True)
class FrameProfile:
    """The parts of a frame, in milliseconds.

    Attributes:
        frame: time of the evaluation of a frame (`scene.frame_set`).
        parts: bones, modifiers and shape keys, and the rest of the evaluation, largest first; drawing last, if there is
            a window.
        times: times with the rig and with models; None if no model can replace the rig of a mesh.
        model_problem: why no model can; else empty.
        fast_rig: what a fast rig would save; None if it was not measured.
        fast_rig_problem: why no fast rig can be made; empty if one can.
    """

    frame: Duration
    parts: tuple[FramePart, ...]
    times: Benchmark | None = None
    model_problem: str = ""
    fast_rig: FastRigSaving | None = None
    fast_rig_problem: str = ""

    @property
    def total(self) -> float:
        """Return the sum of the parts, ms: it may differ from evaluation and drawing by the noise."""
        return sum(part.duration.median for part in self.parts)

    def to_json(self) -> dict:
        """Return the profile as JSON, described in docs/formats.md."""
        return {
            "unit": "ms",
            "profile": {
                "frame": self.frame.to_json(),
                "parts": [{**asdict(part), "duration": part.duration.to_json()} for part in self.parts],
                "models": self.times and self.times.to_json(),
                "model_problem": self.model_problem,
                "fast_rig": self.fast_rig and asdict(self.fast_rig),
                "fast_rig_problem": self.fast_rig_problem,
            },
            "blender": bpy.app.version_string,
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
        }

    def table(self) -> str:
        """Format the profile as one bar and tables."""
        letters, bar = "ABCDEFGHIJKLMNOPQRSTUVWXYZ", ""
        lines = [f"A frame takes {self.frame} ms to evaluate (median, ± spread over {ROUNDS} rounds)."]
        rows = []
        shown_parts = [part for part in self.parts if part.kind == REST or part.duration.median > 0]
        for index, part in enumerate(shown_parts):
            letter, share = letters[index % len(letters)], part.duration.median / max(self.total, 1e-9)
            bar += letter * round(BAR_WIDTH * share)
            rows.append(f"  {letter} {part.title:<44}{part.duration!s:>16}{share:>7.0%}")
        return "\n".join([*lines, f"  {bar}", *rows, *self.savings_sentences()])

    def savings_sentences(self) -> list[str]:
        """Return sentences about the most expensive modifier, and what models and a fast rig would save.

        Their times are those of the frame, divided by measured ratios, so that they can be compared.
        """
        frame_ms, sentences = self.frame.median, []
        modifiers = [part for part in self.parts if part.kind == MODIFIER]
        if largest := max(modifiers, key=lambda part: part.duration.median, default=None):
            sentences.append(
                f"The most expensive modifier is {largest.name} of {largest.object}: {largest.duration.median:.2f} ms."
            )
        if self.times is None:
            sentences.append(f"No model can replace the rig: {self.model_problem}")
        else:
            times, rig_ms = self.times, self.times.median(RIG)
            subject = "All" if times.model_count == len(times.meshes) else f"{times.model_count} of {len(times.meshes)}"
            subject = "The model" if len(times.meshes) == 1 else f"{subject} meshes with models"
            sentences.append(f"{subject}: {frame_ms / times.ratio:.2f} ms. {times.sentence}")
            for mesh in times.meshes if len(times.meshes) > 1 else ():
                if mesh.reason:
                    sentences.append(f"{mesh.name} has no model: {mesh.reason}")
                elif mesh.variant in times.times:
                    ms = frame_ms * times.median(mesh.variant) / rig_ms
                    sentences.append(f"Only {mesh.name} with a model: {ms:.2f} ms.")
        if self.fast_rig is not None:
            sentences.append(self.fast_rig.describe(frame_ms))
        elif self.fast_rig_problem:
            sentences.append(f"A fast rig cannot be made: {self.fast_rig_problem}")
        return sentences
