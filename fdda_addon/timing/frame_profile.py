# SPDX-License-Identifier: GPL-3.0-or-later
"""The profile of a frame: how much time its parts take, and what a model and a fast rig would save.

Each part is the difference of two measurements that follow each other, with and without the part, as a ratio of the
whole frame, so that other work on the machine slows both. The median over several rounds counts, and the spread over
the rounds tells how sure it is.
"""

import os
import platform
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product

import bpy
import numpy as np

from ..core.errors import FDDAError
from ..core.progress import Job, Progress
from ..rig.modifier_stack import check_posable, is_fdda_modifier
from ..rig.shape_keys import muted_key_drivers
from ..runtime.binding import model_disabled
from ..scene.scene_rig import SceneRig, check_full_rig, rigs_of_armature
from ..scene.temporary_state import temporary_attributes
from .animation import main_rig, temporary_animation
from .benchmark import RIG, Benchmark, benchmark
from .durations import Duration, frame_ms, temporary_armature_scene, time_redraws

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


FRAMES_PER_ROUND, TIMED_FRAMES = 8, 30

MIN_SHARE = 0.01
"""Smallest share of an object in a frame that is shown by itself."""


def profile_frame(armature_object: bpy.types.Object) -> Job[FrameProfile]:
    """Profile a frame of the scene while the generator is iterated, and time models of the character (`benchmark`).

    It plays the action of the armature, or random poses if there is none, and restores the scene afterwards. Bound
    models do not play while the parts of the frame are measured. In a window, it also draws.
    """
    rigs = rigs_of_armature(armature_object)
    with ExitStack() as stack:
        for scene_rig in rigs:
            check_full_rig(scene_rig.mesh_object)
            stack.enter_context(model_disabled(scene_rig.mesh_object))
        check_posable(main_rig(rigs))
        profile = yield from _profile_shown_rig(rigs)
    try:
        return replace(profile, times=(yield from benchmark(armature_object, TIMED_FRAMES)))
    except FDDAError as error:
        return replace(profile, model_problem=str(error))


def _profile_shown_rig(rigs: list[SceneRig]) -> Job[FrameProfile]:
    """Measure each part as a ratio of a whole frame that is measured just before."""
    armature_object, mesh_objects = rigs[0].armature_object, {rig.mesh_object for rig in rigs}
    frame_rounds: list[float] = []
    bone_ratios: list[float] = []
    part_ratios: dict[bpy.types.Object, dict[tuple[str, str], list[float]]] = {}
    with temporary_animation(main_rig(rigs)) as frames:
        evaluated = [d.original for d in bpy.context.evaluated_depsgraph_get().ids if isinstance(d, bpy.types.Object)]
        objects = {o.name: o for o in evaluated if o.type != "ARMATURE" and _removable_parts(o)}
        measured = [None, *(objects[name] for name in sorted(objects))]
        with temporary_armature_scene(armature_object) as armature_scene:
            for step, (round_index, scene_object) in enumerate(product(range(ROUNDS), measured), 1):
                # Objects that take next to nothing in the first round belong to the rest.
                if round_index and scene_object is not None and scene_object not in part_ratios:
                    continue
                measure = partial(
                    frame_ms,
                    animation_frames=frames,
                    first_index=round_index * FRAMES_PER_ROUND,
                    count=FRAMES_PER_ROUND,
                )
                whole_ms = previous_ms = measure(bpy.context.scene)
                frame_rounds.append(whole_ms)
                if scene_object is None:
                    bone_ratios.append(measure(armature_scene) / whole_ms)
                else:
                    ratios = part_ratios.setdefault(scene_object, {})
                    with ExitStack() as stack:
                        # From the last modifier to the first, because the result of the first is the input of the next.
                        for part in _removable_parts(scene_object):
                            _disable_part(stack, scene_object, *part)
                            remaining_ms = measure(bpy.context.scene)
                            ratios.setdefault(part, []).append((previous_ms - remaining_ms) / whole_ms)
                            previous_ms = remaining_ms
                    if (
                        not round_index
                        and scene_object not in mesh_objects
                        and whole_ms - previous_ms < MIN_SHARE * whole_ms
                    ):
                        del part_ratios[scene_object]
                yield Progress("objects", step, ROUNDS * len(measured))
        redraw_rounds = yield from time_redraws(frames, ROUNDS, FRAMES_PER_ROUND)
    rows, rest = {(BONES, armature_object.name, ""): bone_ratios}, 1 - np.array(bone_ratios)
    for scene_object, ratios in part_ratios.items():
        object_ratios = np.sum(list(ratios.values()), axis=0)
        share = Duration.of(object_ratios)
        # Objects within the noise belong to the rest.
        if share.median > max(share.spread, MIN_SHARE) or scene_object in mesh_objects:
            rows |= {(kind, scene_object.name, name): each for (kind, name), each in ratios.items()}
            rest -= object_ratios
    frame = Duration.of(frame_rounds)
    parts = [
        FramePart(*key, Duration.of(np.multiply(ratios, frame.median)))
        for key, ratios in (rows | {(REST, "", ""): rest}).items()
    ]
    parts.sort(key=lambda part: -part.duration.median)
    if redraw_rounds:
        parts.append(FramePart(DRAWING, "", "", Duration.of(redraw_rounds)))
    return FrameProfile(frame, tuple(parts))


def _removable_parts(scene_object: bpy.types.Object) -> list[tuple[str, str]]:
    """Return kind and name of the parts that can be disabled.

    These are modifiers from the last to the first, then shape keys and their drivers.
    """
    parts = [
        (MODIFIER, modifier.name)
        for modifier in reversed(scene_object.modifiers)
        if modifier.show_viewport and not is_fdda_modifier(modifier)
    ]
    shape_keys = getattr(scene_object.data, "shape_keys", None)
    if shape_keys is not None and len(shape_keys.key_blocks) > 1:
        parts.append((SHAPE_KEYS, ""))
        drivers = shape_keys.animation_data.drivers if shape_keys.animation_data else ()
        if any(not curve.mute for curve in drivers):
            parts.append((KEY_DRIVERS, ""))
    return parts


def _disable_part(stack: ExitStack, scene_object: bpy.types.Object, kind: str, name: str) -> None:
    """Disable a part of `_removable_parts` until the stack is closed."""
    if kind == MODIFIER:
        stack.enter_context(temporary_attributes(scene_object.modifiers[name], show_viewport=False))
    elif kind == KEY_DRIVERS:
        stack.enter_context(muted_key_drivers(scene_object))
    else:
        stack.enter_context(temporary_attributes(scene_object, show_only_shape_key=True, active_shape_key_index=0))
