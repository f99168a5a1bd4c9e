# SPDX-License-Identifier: GPL-3.0-or-later
"""Profiles a frame: measures how much time its parts take.

Each part is the difference of two measurements that follow each other, with and without the part, as a ratio of the
whole frame, so that other work on the machine slows both. The median over several rounds counts, and the spread over
the rounds tells how sure it is.
"""

from contextlib import ExitStack
from dataclasses import replace
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
from .benchmark import benchmark
from .durations import Duration, frame_ms, temporary_armature_scene, time_redraws
from .frame_profile import BONES, DRAWING, KEY_DRIVERS, MODIFIER, REST, ROUNDS, SHAPE_KEYS, FramePart, FrameProfile

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
    with temporary_animation(main_rig(rigs)) as frames, temporary_armature_scene(armature_object) as armature_scene:
        evaluated = [d.original for d in bpy.context.evaluated_depsgraph_get().ids if isinstance(d, bpy.types.Object)]
        objects = {o.name: o for o in evaluated if o.type != "ARMATURE" and _removable_parts(o)}
        measured = [None, *(objects[name] for name in sorted(objects))]
        for step, (round_index, scene_object) in enumerate(product(range(ROUNDS), measured), 1):
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
