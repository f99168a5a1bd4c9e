# SPDX-License-Identifier: GPL-3.0-or-later
"""Shows random poses of a recording in advance, and the rest pose."""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from ..core.errors import RigError
from ..scene.armature import Poser, clear_pose, pose_values
from ..scene.control_names import control_default
from ..scene.controls import can_be_set, is_driven, owner_of, set_control
from ..scene.scene_rig import SceneRig
from .plan import (
    RecordingSettings,
    make_pose_sampler,
    make_recording_overshoot,
    read_sample_selection,
    read_sampled_rig,
)

_shown_pose: "tuple[int, np.ndarray] | None" = None
"""Session id of the armature object that shows a random pose, and the values of the pose."""


def show_random_pose(scene_rig: SceneRig, settings: "RecordingSettings", index: int) -> int:
    """Set one of the random poses of a recording.

    Limit constraints stay on, so an overshoot pose is shown within the limits that they enforce; a recording
    suspends them.

    Args:
        settings: settings of the recording.
        index: index of the random pose, from 0.

    Returns:
        The index of the pose that is shown: `index`, or the index of the last random pose if that is smaller.
    """
    global _shown_pose

    settings = replace(settings, poses=max(1, settings.poses))
    index = min(index, settings.poses - 1)
    _, channels = read_sampled_rig(scene_rig, settings)
    overshoot = make_recording_overshoot(scene_rig, settings, channels)
    sampler = make_pose_sampler(scene_rig, settings)
    if overshoot and index >= settings.poses - overshoot.poses:
        channels, sampler = overshoot.channels, replace(sampler, remix=None)
    clear_pose(scene_rig.armature_object)
    Poser(scene_rig, channels).set(sampler.draw_pose(channels, index))
    scene_rig.armature_object.update_tag(refresh={"DATA"})
    _shown_pose = scene_rig.armature_object.session_uid, pose_values(scene_rig.armature_object)
    return index


def shows_random_pose(scene_rig: SceneRig) -> bool:
    """Return whether the rig is still in the pose that `show_random_pose` has set."""
    armature_object = scene_rig.armature_object
    if _shown_pose is None or _shown_pose[0] != armature_object.session_uid:
        return False
    values = pose_values(armature_object)
    return values.shape == _shown_pose[1].shape and bool((values == _shown_pose[1]).all())


def show_rest_pose(scene_rig: SceneRig, settings: "RecordingSettings | None") -> None:
    """Set the rest pose, and the extra inputs of random poses to their defaults; inputs with drivers keep theirs.

    Args:
        settings: settings of the recording; None to keep the extra inputs.
    """
    clear_pose(scene_rig.armature_object)
    if settings is None:
        return
    # While a chosen bone or action is missing, random poses change no input.
    with suppress(RigError):
        for control in read_sample_selection(scene_rig, settings)[0].controls:
            if can_be_set(control.name) and not is_driven(owner_of(scene_rig, control.owner), control.path):
                set_control(scene_rig, control.name, control_default(scene_rig, control.name))
