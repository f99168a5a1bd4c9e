# SPDX-License-Identifier: GPL-3.0-or-later
"""Modes that are animated, modifiers and controls that change while a model plays: near the rig, or the rig and why."""

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

from fdda_addon.runtime.binding import bind, model_disabled
from fdda_addon.scene.scene_rig import find_rig
from tests.blender.conftest import ELBOW, ELBOW_RIG, evaluated
from tests.blender.test_broken_characters import with_control

from .cases import ShortfallError
from .playback import open_bound, repeat

NEAR = 2e-3
"""Metres that the model of the elbow may be off inside its range."""
KINDS = ("SUBSURF", "MIRROR", "DECIMATE", "WELD", "SMOOTH", "CAST", "WAVE", "WEIGHTED_NORMAL")
Random = np.random.Generator


def run_mode(folder: Path, seed: int, first: int, end: int) -> None:
    """Keys and drivers of the mode and of the eye, modes and eyes by hand, rigs that are borrowed."""
    bound, random = open_bound(folder), np.random.default_rng((seed, first))

    def drive(owner: bpy.types.bpy_struct, name: str, expression: str) -> None:
        owner.driver_remove(name)
        owner.driver_add(name).driver.expression = expression

    actions: list[Callable[[], object]] = [
        lambda: drive(bound.fdda, "mode", "2 * (frame % 7 > 2)"),
        lambda: drive(bound.modifiers["FDDA"], "show_viewport", "frame % 5 > 1"),
        lambda: bound.fdda.keyframe_insert("mode", frame=int(random.integers(1, 31))),
        lambda: bound.modifiers["FDDA"].keyframe_insert("show_viewport", frame=int(random.integers(1, 31))),
        bound.animation_data_clear,
        lambda: setattr(bound.fdda, "mode", str(random.choice(["RIG", "FDDA", "FDDA"]))),
        lambda: setattr(bound.modifiers["FDDA"], "show_viewport", bool(random.integers(2))),
        lambda: setattr(bound.modifiers["FDDA"], "show_render", bool(random.integers(2))),
        lambda: setattr(bound.fdda, "use_in_render", bool(random.integers(2))),
    ]
    repeat("mode", first, end, lambda: _change(bound, random, actions))


def run_topology(folder: Path, seed: int, first: int, end: int) -> None:
    """Modifiers that come, go, move and change, B-Bones, preserved volume."""
    bound, random = open_bound(folder), np.random.default_rng((seed, first))
    armature = bpy.data.objects[ELBOW_RIG].data

    def add() -> None:
        if len(bound.modifiers) < 7:
            bound.modifiers.new("Added", str(random.choice(KINDS)))
            move()

    def any_modifier() -> bpy.types.Modifier:
        return bound.modifiers[int(random.integers(len(bound.modifiers)))]

    def move() -> None:
        bound.modifiers.move(len(bound.modifiers) - 1, int(random.integers(len(bound.modifiers))))

    def remove() -> None:
        for modifier in [m for m in bound.modifiers if m.name.startswith("Added")][: int(random.integers(1, 4))]:
            bound.modifiers.remove(modifier)

    def settle() -> None:
        """As it was recorded."""
        for modifier in [m for m in bound.modifiers if m.name.startswith("Added")]:
            bound.modifiers.remove(modifier)
        bound.fdda.mode = "RIG"
        for place, name in enumerate(("Armature", "CorrectiveSmooth", "FDDA")):
            bound.modifiers.move(bound.modifiers.find(name), place)
            bound.modifiers[name].show_viewport = name != "FDDA"
        bound.modifiers["CorrectiveSmooth"].iterations = 8
        bound.modifiers["Armature"].use_deform_preserve_volume = False
        armature.bones["lower"].bbone_segments = 1
        bound.fdda.mode = "FDDA"

    actions: list[Callable[[], object]] = [
        *(add, add, move, remove, settle, settle),
        lambda: setattr(any_modifier(), "show_viewport", bool(random.integers(2))),
        lambda: setattr(bound.modifiers["CorrectiveSmooth"], "iterations", int(random.integers(6, 10))),
        lambda: setattr(bound.modifiers["Armature"], "use_deform_preserve_volume", bool(random.integers(2))),
        lambda: setattr(armature.bones["lower"], "bbone_segments", int(random.integers(1, 4))),
        lambda: setattr(bound.fdda, "mode", "FDDA"),
    ]
    repeat("topology", first, end, lambda: _change(bound, random, actions))


def run_controls(folder: Path, seed: int, first: int, end: int) -> None:
    """A control that is renamed, removed and there again."""
    bound, random = open_bound(folder), np.random.default_rng((seed, first))
    owner = bpy.data.objects[ELBOW_RIG]
    owner["dial"] = 0.5
    bind(find_rig(ELBOW), with_control(folder / "elbow.onnx", "armature_object", '["dial"]'))

    def remove() -> None:
        owner.pop("dial", None)
        owner.update_tag()

    def restore() -> None:
        owner["dial"] = float(random.random())
        owner.update_tag()

    actions = [remove, restore, lambda: setattr(bound.fdda, "mode", "FDDA")]

    def change() -> float:
        off = _change(bound, random, actions)
        if "dial" not in owner and not bound.fdda.status:
            raise ShortfallError("the control is gone, and the model plays")
        return off

    repeat("controls", first, end, change)


def _change(bound: bpy.types.Object, random: Random, actions: list[Callable[[], object]]) -> float:
    """Do something, go to a frame or not, and compare with the rig; how far the model is off."""
    actions[int(random.integers(len(actions)))]()
    if random.random() < 0.6:
        bpy.context.scene.frame_set(int(random.integers(1, 31)))
    bpy.context.view_layer.update()
    shown, is_playing, status = evaluated(bound), bound.fdda.is_playing, bound.fdda.status
    with model_disabled(bound):
        if random.random() < 0.2:
            bound.modifiers["FDDA"].show_viewport = True
        bpy.context.view_layer.update()
        rig = evaluated(bound)
    bpy.context.view_layer.update()
    if len(shown) != len(rig):
        raise ShortfallError(f"{len(shown)} vertices are shown and the rig has {len(rig)}: {status}")
    off = float(np.abs(shown - rig).max())
    if off > (NEAR if is_playing else 0):
        raise ShortfallError(f"it is {off} m off {'the rig' if is_playing else 'though no model plays'}: {status}")
    return off
