# SPDX-License-Identifier: GPL-3.0-or-later
"""Shows random poses of a recording in advance."""

from dataclasses import replace
from typing import TYPE_CHECKING

from ..scene.scene_rig import SceneRig

if TYPE_CHECKING:  # Blender starts without numpy.
    from .plan import RecordingSettings


def show_random_pose(scene_rig: SceneRig, settings: "RecordingSettings", index: int) -> int:
    """Set one of the random poses of a recording.

    Limit constraints stay on, so a pose of the margin is shown within the limits that they enforce; a recording
    suspends them.

    Args:
        scene_rig: the rig.
        settings: settings of the recording.
        index: index of the random pose, from 0.

    Returns:
        The index of the pose that is shown: `index`, or the index of the last random pose if that is smaller.

    Raises:
        RigError: there is no channel to sample.
    """
    from ..core.poses import sample_pose
    from ..scene.armature import Poser, clear_pose
    from .plan import make_recording_margin, read_sampled_rig

    settings = replace(settings, poses=max(1, settings.poses))
    index = min(index, settings.poses - 1)
    _, channels = read_sampled_rig(scene_rig, settings)
    margin = make_recording_margin(scene_rig, settings, channels)
    if margin and index >= settings.poses - margin.poses:
        channels = margin.channels
    clear_pose(scene_rig.armature_object)
    Poser(scene_rig, channels).set(sample_pose(channels, settings.seed, index, settings.spread))
    scene_rig.armature_object.update_tag(refresh={"DATA"})
    return index
