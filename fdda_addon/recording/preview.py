# SPDX-License-Identifier: GPL-3.0-or-later
"""Preview of the random poses of a recording."""

from dataclasses import replace
from typing import TYPE_CHECKING

from ..scene.scene_rig import SceneRig

if TYPE_CHECKING:  # Blender starts without numpy.
    from .plan import RecordingSettings


def show_random_pose(scene_rig: SceneRig, settings: "RecordingSettings", index: int) -> None:
    """Pose a rig as in one of the random poses of a recording.

    Args:
        scene_rig: the rig.
        settings: of the recording.
        index: of the random pose, from 0.

    Raises:
        RigError: there is nothing to pose.
    """
    from ..core.poses import sample_pose
    from ..scene.armature import Poser, clear_pose
    from .plan import read_sampled_rig

    _, channels = read_sampled_rig(scene_rig, replace(settings, poses=max(1, settings.poses)))
    clear_pose(scene_rig.armature_object)
    Poser(scene_rig, channels).set(sample_pose(channels, settings.seed, index, settings.spread))
    scene_rig.armature_object.update_tag(refresh={"DATA"})
