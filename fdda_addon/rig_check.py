# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks a rig as a recording would, and says all that is wrong at once."""

from dataclasses import dataclass

from .core.errors import RigError
from .core.poses import Channel
from .core.rig import Rig
from .scene.modifier_stack import deforming_modifiers
from .scene.rig import SceneRig, check_evaluable, read_rig, sampled_channels


@dataclass(frozen=True)
class RigCheck:
    """What is known about a rig.

    Attributes:
        problems: why it cannot be recorded, a sentence each; empty when it can.
        rig: its arrays, None when they cannot be read.
        channels: what a random pose may move, empty when nothing.
        replaced: names of the modifiers that a model takes the place of.
    """

    problems: tuple[str, ...]
    rig: Rig | None
    channels: tuple[Channel, ...]
    replaced: tuple[str, ...] = ()

    def checked_again(self, scene_rig: SceneRig) -> "RigCheck":
        """The check without reading the mesh again: for changes of modifiers, modes and ranges of motion."""
        return _check(scene_rig, self.rig) if self.rig else check(scene_rig)


def check(scene_rig: SceneRig) -> RigCheck:
    """Check a rig. While a model plays, the modifiers of the rig are off, so what they evaluate to is not checked."""
    return _check(scene_rig, None)


def _check(scene_rig: SceneRig, rig: Rig | None) -> RigCheck:
    problems: list[str] = []
    channels: tuple[Channel, ...] = ()
    replaced: tuple[str, ...] = ()
    if not scene_rig.mesh_object.fdda.is_playing:
        try:
            check_evaluable(scene_rig)
        except RigError as error:
            problems.append(str(error))
    try:
        replaced = tuple(modifier.name for modifier in deforming_modifiers(scene_rig.mesh_object))
        rig = rig or read_rig(scene_rig)
    except RigError as error:
        if str(error) not in problems:
            problems.append(str(error))
        return RigCheck(tuple(problems), None, (), replaced)
    try:
        channels = sampled_channels(scene_rig, rig)
    except RigError as error:
        # A rig that is driven by controls is recorded by its actions alone.
        if scene_rig.mesh_object.fdda.settings.poses:
            problems.append(str(error))
    return RigCheck(tuple(problems), rig, channels, replaced)
