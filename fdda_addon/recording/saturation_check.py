# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks before a recording that a surface changes in the whole range of a control."""

import numpy as np

from ..core.mathematics.partition import INFLUENCE_TOLERANCE
from ..core.recording.target import POSE
from ..scene.controls import can_be_set, is_driven, number_at, owner_of, set_control
from .recorded_mesh import RecordedMesh

MIN_CHECKED_WIDTH = 10.0
"""Width of the ranges that are checked. Nearly all numbers that are made for animation have narrower ranges."""
VALUE_COUNT = 17
"""Number of values at which the surface is compared."""
MAX_CHANGE_RATIO = 1 / 8
"""A range saturates if the surface changes in at most this part of it."""


def check_saturation(mesh: RecordedMesh) -> str:
    """Return a sentence about the controls whose effect ends far inside their ranges; empty if there is none.

    Random poses would hardly ever show the values between the two ends of the effect.

    Args:
        mesh: the mesh in its rest pose, prepared by `temporary_rig_states`.
    """
    if mesh.target and mesh.target.follows != POSE:
        return ""
    scene_rig, sentences = mesh.scene_rig, []
    for control in mesh.rig.controls:
        owner, (low, high) = owner_of(scene_rig, control.owner), (control.low, control.high)
        if high - low < MIN_CHECKED_WIDTH or not can_be_set(control.name) or is_driven(owner, control.path):
            continue
        previous_value = number_at(owner, control.path)
        # Each step finds the part of the range with the effect, until it fills its part.
        while True:
            compared = np.linspace(low, high, VALUE_COUNT)
            surfaces = []
            for value in compared.tolist():
                set_control(scene_rig, control.name, value)
                surfaces.append(mesh.evaluator.evaluate()[1])
            moves = np.linalg.norm(np.diff(surfaces, axis=0), axis=2).max(axis=1)
            changed = np.flatnonzero(moves > INFLUENCE_TOLERANCE * mesh.rig.size)
            if len(changed):
                low, high = float(compared[changed[0]]), float(compared[changed[-1] + 1])
            if not 0 < len(changed) <= MAX_CHANGE_RATIO * (VALUE_COUNT - 1) or high - low < 1:
                break
        set_control(scene_rig, control.name, previous_value)
        if high - low < MAX_CHANGE_RATIO * (control.high - control.low):
            sentences.append(
                f"The surface of '{mesh.name}' changes only between {low:.3g} and {high:.3g} in the range "
                f"{control.low:g} to {control.high:g} of '{control.name}'. Give the range that is used: --control "
                f"'{control.name}={low:.3g}:{high:.3g}', or Soft Min and Soft Max of the property."
            )
    return " ".join(sentences)
