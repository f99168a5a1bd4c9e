# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks a rig as a recording would, and says all that is wrong at once."""

from dataclasses import dataclass, replace

from ..core.controls import Control
from ..core.errors import RigError
from ..core.poses import Channel
from ..core.rig import Rig
from ..poses.sampling import sampled_channels
from ..rig.modifier_stack import check_evaluable, deforming_modifiers
from ..rig.reading import read_rig
from ..rig.time_inputs import check_time_inputs
from ..scene.scene_rig import SceneRig
from .plan import RecordingSettings, depends_on_time, find_actions, listed_controls, read_sampling_choice

DEFAULTS = RecordingSettings()


@dataclass(frozen=True)
class RigCheck:
    """What is known about a rig.

    Attributes:
        problems: why it cannot be recorded, a sentence each; empty when it can.
        rig: its arrays, None when they cannot be read.
        channels: what a random pose may move, empty when nothing.
        replaced: names of the modifiers that a model takes the place of.
        found: the controls that nobody listed: drivers of the mesh read them, or the actions that are sampled key them.
        extra_joints, include_static_joint: what the rig was read with (`read_rig`).
    """

    problems: tuple[str, ...]
    rig: Rig | None
    channels: tuple[Channel, ...]
    replaced: tuple[str, ...] = ()
    found: tuple[Control, ...] = ()
    extra_joints: frozenset[str] | None = None
    include_static_joint: bool = False

    def checked_again(self, scene_rig: SceneRig, settings: RecordingSettings = DEFAULTS) -> "RigCheck":
        """The check without reading the mesh again: for changes of modifiers, modes, ranges of motion and choices."""
        return _check(scene_rig, settings, self)


def check(scene_rig: SceneRig, settings: RecordingSettings = DEFAULTS) -> RigCheck:
    """Check a rig. While a model plays, the modifiers of the rig are off, so what they evaluate to is not checked."""
    return _check(scene_rig, settings, None)


def _check(scene_rig: SceneRig, settings: RecordingSettings, before: RigCheck | None) -> RigCheck:
    result = RigCheck((), None, ())
    problems: list[str] = []
    stack = None
    if not scene_rig.mesh_object.fdda.is_playing:
        try:
            stack = check_evaluable(scene_rig)
        except RigError as error:
            problems.append(str(error))
    try:
        result = replace(result, replaced=tuple(m.name for m in deforming_modifiers(scene_rig.mesh_object)))
        choice, extra_joints = read_sampling_choice(scene_rig, settings)
        if stack is not None and not settings.target.name:
            try:
                check_time_inputs(scene_rig, choice.controls, stack, find_actions(settings))
            except RigError as error:
                problems.append(str(error))
        include_static_joint = depends_on_time(scene_rig, settings)
        read_with = extra_joints, include_static_joint
        if (
            before is not None
            and before.rig is not None
            and (before.extra_joints, before.include_static_joint) == read_with
        ):
            rig = before.rig
        else:
            rig = read_rig(scene_rig, *read_with)
        if rig.controls != choice.controls:
            rig = replace(rig, controls=choice.controls)
        listed = listed_controls(scene_rig, settings)
        found = tuple(control for control in choice.controls if control not in listed)
        result = replace(
            result, rig=rig, found=found, extra_joints=extra_joints, include_static_joint=include_static_joint
        )
        result = replace(result, channels=sampled_channels(scene_rig, rig, choice))
    except RigError as error:
        # A rig of which nothing may be sampled is recorded by its actions alone.
        if str(error) not in problems and (result.rig is None or settings.poses):
            problems.append(str(error))
    return replace(result, problems=tuple(problems))
