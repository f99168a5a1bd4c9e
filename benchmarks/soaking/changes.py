# SPDX-License-Identifier: GPL-3.0-or-later
"""Soak test of changes to the mode, the modifiers and the controls while a model plays.

The mesh must stay close to the rig. Where the model stops playing, the mesh must equal the rig.
"""

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

from fdda_addon.runtime.binding import bind, model_disabled
from fdda_addon.scene.scene_rig import find_rig
from tests.blender.conftest import ELBOW, ELBOW_RIG, evaluated_positions
from tests.blender.test_broken_characters import add_control_to_model

from .cases import CaseFailedError
from .playback import open_bound, repeat

MAX_MODEL_ERROR_M = 2e-3
"""Largest error of the elbow's model inside its trained range, meters."""
KINDS = ("SUBSURF", "MIRROR", "DECIMATE", "WELD", "SMOOTH", "CAST", "WAVE", "WEIGHTED_NORMAL")
Random = np.random.Generator


def run_mode(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Animate the mode and the visibility of the modifier with keyframes and drivers, and set both directly."""
    bound, random = open_bound(folder), np.random.default_rng((seed, first_case))

    def add_driver(owner: bpy.types.bpy_struct, name: str, expression: str) -> None:
        owner.driver_remove(name)
        owner.driver_add(name).driver.expression = expression

    actions: list[Callable[[], object]] = [
        lambda: add_driver(bound.fdda, "mode", "2 * (frame % 7 > 2)"),
        lambda: add_driver(bound.modifiers["FDDA"], "show_viewport", "frame % 5 > 1"),
        lambda: bound.fdda.keyframe_insert("mode", frame=int(random.integers(1, 31))),
        lambda: bound.modifiers["FDDA"].keyframe_insert("show_viewport", frame=int(random.integers(1, 31))),
        bound.animation_data_clear,
        lambda: setattr(bound.fdda, "mode", str(random.choice(["RIG", "FDDA", "FDDA"]))),
        lambda: setattr(bound.modifiers["FDDA"], "show_viewport", bool(random.integers(2))),
        lambda: setattr(bound.modifiers["FDDA"], "show_render", bool(random.integers(2))),
        lambda: setattr(bound.fdda, "use_in_render", bool(random.integers(2))),
    ]
    repeat("mode", first_case, end_case, lambda: _change_and_compare(bound, random, actions))


def run_topology(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Add, remove, move and change modifiers; change B-Bones and Preserve Volume."""
    bound, random = open_bound(folder), np.random.default_rng((seed, first_case))
    armature = bpy.data.objects[ELBOW_RIG].data

    def add_modifier() -> None:
        if len(bound.modifiers) < 7:
            bound.modifiers.new("Added", str(random.choice(KINDS)))
            move_modifier()

    def random_modifier() -> bpy.types.Modifier:
        return bound.modifiers[int(random.integers(len(bound.modifiers)))]

    def move_modifier() -> None:
        bound.modifiers.move(len(bound.modifiers) - 1, int(random.integers(len(bound.modifiers))))

    def remove_modifiers() -> None:
        for modifier in [m for m in bound.modifiers if m.name.startswith("Added")][: int(random.integers(1, 4))]:
            bound.modifiers.remove(modifier)

    def restore_recorded_setup() -> None:
        """Restore the modifiers and bones that the model was recorded with."""
        for modifier in [m for m in bound.modifiers if m.name.startswith("Added")]:
            bound.modifiers.remove(modifier)
        bound.fdda.mode = "RIG"
        for index, name in enumerate(("Armature", "CorrectiveSmooth", "FDDA")):
            bound.modifiers.move(bound.modifiers.find(name), index)
            bound.modifiers[name].show_viewport = name != "FDDA"
        bound.modifiers["CorrectiveSmooth"].iterations = 8
        bound.modifiers["Armature"].use_deform_preserve_volume = False
        armature.bones["lower"].bbone_segments = 1
        bound.fdda.mode = "FDDA"

    actions: list[Callable[[], object]] = [
        *(add_modifier, add_modifier, move_modifier, remove_modifiers),
        *(restore_recorded_setup, restore_recorded_setup),
        lambda: setattr(random_modifier(), "show_viewport", bool(random.integers(2))),
        lambda: setattr(bound.modifiers["CorrectiveSmooth"], "iterations", int(random.integers(6, 10))),
        lambda: setattr(bound.modifiers["Armature"], "use_deform_preserve_volume", bool(random.integers(2))),
        lambda: setattr(armature.bones["lower"], "bbone_segments", int(random.integers(1, 4))),
        lambda: setattr(bound.fdda, "mode", "FDDA"),
    ]
    repeat("topology", first_case, end_case, lambda: _change_and_compare(bound, random, actions))


def run_controls(folder: Path, seed: int, first_case: int, end_case: int) -> None:
    """Remove a control of the model and add it again."""
    bound, random = open_bound(folder), np.random.default_rng((seed, first_case))
    owner = bpy.data.objects[ELBOW_RIG]
    owner["dial"] = 0.5
    bind(find_rig(ELBOW), add_control_to_model(folder / "elbow.onnx", "armature_object", '["dial"]'))

    def remove_control() -> None:
        owner.pop("dial", None)
        owner.update_tag()

    def restore_control() -> None:
        owner["dial"] = float(random.random())
        owner.update_tag()

    actions = [remove_control, restore_control, lambda: setattr(bound.fdda, "mode", "FDDA")]

    def change_and_check() -> float:
        error_m = _change_and_compare(bound, random, actions)
        if "dial" not in owner and not bound.fdda.status:
            raise CaseFailedError("the model plays although its control does not exist")
        return error_m

    repeat("controls", first_case, end_case, change_and_check)


def _change_and_compare(bound: bpy.types.Object, random: Random, actions: list[Callable[[], object]]) -> float:
    """Run a random action and compare the mesh with the rig; return the error of the model, meters."""
    actions[int(random.integers(len(actions)))]()
    if random.random() < 0.6:
        bpy.context.scene.frame_set(int(random.integers(1, 31)))
    bpy.context.view_layer.update()
    shown_positions, is_playing, status = evaluated_positions(bound), bound.fdda.is_playing, bound.fdda.status
    with model_disabled(bound):
        if random.random() < 0.2:
            bound.modifiers["FDDA"].show_viewport = True
        bpy.context.view_layer.update()
        rig_positions = evaluated_positions(bound)
    bpy.context.view_layer.update()
    if len(shown_positions) != len(rig_positions):
        raise CaseFailedError(f"{len(shown_positions)} vertices instead of the rig's {len(rig_positions)}: {status}")
    error_m = float(np.abs(shown_positions - rig_positions).max())
    if error_m > (MAX_MODEL_ERROR_M if is_playing else 0):
        reason = "" if is_playing else " although no model plays"
        raise CaseFailedError(f"the mesh is {error_m} m from the rig{reason}: {status}")
    return error_m
