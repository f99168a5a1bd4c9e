# SPDX-License-Identifier: GPL-3.0-or-later
"""Prepares a rig for posing, and restores everything that posing changes."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from ..core.mathematics.poses import CONTROL, Channel
from ..core.rig import Rig
from ..poses.clip import Clip
from ..poses.clip_player import ClipPlayer, clip_player
from ..scene.comparison import hidden_comparison_objects
from ..scene.controls import temporary_controls
from ..scene.scene_rig import SceneRig
from ..scene.time_stretching import unstretched_time
from .modifier_stack import downstream_disabled


@contextmanager
def temporary_rig_state(
    scene_rig: SceneRig, rig: Rig, channels: tuple[Channel, ...] = (), clips: tuple[Clip, ...] = ()
) -> Iterator[ClipPlayer]:
    """Set a rig to the rest pose, without animation; restore modifiers, pose, controls, animation and frame afterwards.

    In the block, time is not stretched, so frames of the scene are frames of the clips.

    Args:
        channels: the channels of the random poses that will be set.
        clips: the clips that the yielded player will show.

    Yields:
        The player of the clips.
    """
    names = control_names(rig, channels)
    with ExitStack() as stack:
        player = stack.enter_context(clip_player([(scene_rig, names)], clips))
        stack.enter_context(hidden_comparison_objects())
        for mesh_object in scene_rig.mesh_objects:
            stack.enter_context(downstream_disabled(mesh_object))
        stack.enter_context(unstretched_time())
        stack.enter_context(temporary_controls(scene_rig, names))
        yield player


def control_names(rig: Rig, channels: tuple[Channel, ...]) -> list[str]:
    """Return the names of the controls of a rig, and of further controls that random poses set."""
    sampled_controls = [channel.name for channel in channels if channel.kind == CONTROL]
    return list(dict.fromkeys([*(control.name for control in rig.controls), *sampled_controls]))
