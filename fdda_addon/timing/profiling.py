# SPDX-License-Identifier: GPL-3.0-or-later
"""Profiles a frame: measures how much time its parts take.

Each part is the difference of two measurements that follow each other, with and without the part, as a ratio of the
whole frame, so that other work on the machine slows both. The median over several rounds counts, and the spread over
the rounds tells how sure it is.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace

import bpy

from ..core.errors import FDDAError
from ..core.progress import Job, Progress
from ..rig.modifier_stack import check_posable, is_fdda_modifier
from ..rig.shape_keys import muted_key_drivers
from ..runtime.binding import model_disabled
from ..scene.scene_rig import SceneRig, check_full_rig, rigs_of_armature
from ..scene.temporary_state import temporary_attributes
from .animation import main_rig, temporary_animation
from .benchmark import benchmark
from .durations import Duration, frame_ms, temporary_armature_scene, time_redraws
from .frame_profile import BONES, DRAWING, KEY_DRIVERS, MODIFIER, REST, ROUNDS, SHAPE_KEYS, FramePart, FrameProfile

FRAMES_PER_ROUND, TIMED_FRAMES = 8, 30
MIN_SHARE = 0.01
"""Smallest share of an object in a frame that is divided into its modifiers."""


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
    armature_object = rigs[0].armature_object
    with temporary_animation(main_rig(rigs)) as frames:
        measurement = _Measurement(rigs, frames)
        with temporary_armature_scene(armature_object) as armature_scene:
            yield from measurement.measure_objects(armature_scene)
            yield from measurement.measure_parts()
        redraw_rounds = yield from time_redraws(frames, ROUNDS, FRAMES_PER_ROUND)
    parts = measurement.parts()
    if redraw_rounds:
        parts.append(FramePart(DRAWING, "", "", Duration.of(redraw_rounds)))
    return FrameProfile(Duration.of(measurement.frame_rounds), tuple(parts))


class _Measurement:
    """Times of the parts of a frame, each as a ratio of a whole frame that was measured just before.

    Attributes:
        frame_rounds: times of the whole evaluation, ms.
    """

    def __init__(self, rigs: list[SceneRig], frames: range):
        self._armature_object, self._frames = rigs[0].armature_object, frames
        self._mesh_objects = {rig.mesh_object for rig in rigs}
        self.frame_rounds: list[float] = []
        self._bone_ratios: list[float] = []
        # The objects that Blender evaluates and that have modifiers or shape keys.
        objects = [
            datablock.original
            for datablock in bpy.context.evaluated_depsgraph_get().ids
            if isinstance(datablock, bpy.types.Object) and datablock.original.type != "ARMATURE"
        ]
        removable = {o.name: o for o in objects if _removable_parts(o)}
        self._object_ratios: dict[bpy.types.Object, list[float]] = {removable[name]: [] for name in sorted(removable)}
        self._part_ratios: dict[tuple[str, str, str], list[float]] = {}

    def _frame_ms(self, round_index: int, scene: bpy.types.Scene | None = None) -> float:
        return frame_ms(scene or bpy.context.scene, self._frames, round_index * FRAMES_PER_ROUND, FRAMES_PER_ROUND)

    def _whole_frame_ms(self, round_index: int) -> float:
        self.frame_rounds.append(self._frame_ms(round_index))
        return self.frame_rounds[-1]

    def measure_objects(self, armature_scene: bpy.types.Scene) -> Iterator[Progress]:
        """Measure the bones, and all modifiers and shape keys of each object together."""
        steps_per_round = 1 + len(self._object_ratios)
        for round_index in range(ROUNDS):
            frame_ms = self._whole_frame_ms(round_index)
            self._bone_ratios.append(self._frame_ms(round_index, armature_scene) / frame_ms)
            yield Progress("objects", round_index * steps_per_round + 1, ROUNDS * steps_per_round)
            for index, (scene_object, ratios) in enumerate(self._object_ratios.items(), 2):
                frame_ms = self._whole_frame_ms(round_index)
                with ExitStack() as stack:
                    for kind, name in _removable_parts(scene_object):
                        _disable_part(stack, scene_object, kind, name)
                    ratios.append(1 - self._frame_ms(round_index) / frame_ms)
                yield Progress("objects", round_index * steps_per_round + index, ROUNDS * steps_per_round)

    def measure_parts(self) -> Iterator[Progress]:
        """Measure each modifier and the shape keys of the objects that take a clear share of the frame."""
        objects = [o for o in self._object_ratios if self._is_clear(o) and len(_removable_parts(o)) > 1]
        for round_index in range(ROUNDS):
            for index, scene_object in enumerate(objects, 1):
                with ExitStack() as stack:
                    frame_ms = previous_ms = self._whole_frame_ms(round_index)
                    # From the last modifier to the first, because the result of the first is the input of the next.
                    for kind, name in _removable_parts(scene_object):
                        _disable_part(stack, scene_object, kind, name)
                        remaining_ms = self._frame_ms(round_index)
                        ratios = self._part_ratios.setdefault((kind, scene_object.name, name), [])
                        ratios.append((previous_ms - remaining_ms) / frame_ms)
                        previous_ms = remaining_ms
                yield Progress("modifiers", round_index * len(objects) + index, ROUNDS * len(objects))

    def _is_clear(self, scene_object: bpy.types.Object) -> bool:
        """Return whether the share of an object is larger than the noise; meshes of the character count anyway."""
        share = Duration.of(self._object_ratios[scene_object])
        return share.median > max(share.spread, MIN_SHARE) or scene_object in self._mesh_objects

    def parts(self) -> list[FramePart]:
        """Return the parts of the evaluation, largest first. Objects within the noise belong to the rest."""
        clear_objects = [o for o in self._object_ratios if self._is_clear(o)]
        ratios_by_part = {(BONES, self._armature_object.name, ""): self._bone_ratios, **self._part_ratios}
        divided_objects = {name for _, name, _ in self._part_ratios}
        for scene_object in clear_objects:
            if scene_object.name not in divided_objects:
                kind, name = _removable_parts(scene_object)[0]
                ratios_by_part[kind, scene_object.name, name] = self._object_ratios[scene_object]
        ratios_by_part[REST, "", ""] = [
            1 - bones_ratio - sum(self._object_ratios[o][index] for o in clear_objects)
            for index, bones_ratio in enumerate(self._bone_ratios)
        ]
        frame_ms = Duration.of(self.frame_rounds).median
        parts = [
            FramePart(*key, Duration.of([ratio * frame_ms for ratio in ratios]))
            for key, ratios in ratios_by_part.items()
        ]
        return sorted(parts, key=lambda part: -part.duration.median)


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
