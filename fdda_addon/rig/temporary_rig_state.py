# SPDX-License-Identifier: GPL-3.0-or-later
"""Prepares one or several rigs of an armature for posing, and restores everything that posing changes."""

from collections.abc import Iterator, Sequence
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

PosedRig = tuple[SceneRig, Rig, tuple[Channel, ...]]
"""A rig as scene objects and as arrays, and the channels of the random poses that will be set."""


@contextmanager
def temporary_rig_state(
    scene_rig: SceneRig, rig: Rig, channels: tuple[Channel, ...] = (), clips: tuple[Clip, ...] = ()
) -> Iterator[ClipPlayer]:
    """Prepare one rig for posing, as `temporary_rig_states` does."""
    with temporary_rig_states([(scene_rig, rig, channels)], clips) as player:
        yield player


@contextmanager
def temporary_rig_states(
    rigs: Sequence[PosedRig], clips: tuple[Clip, ...] = (), other_rigs: Sequence[PosedRig] = ()
) -> Iterator[ClipPlayer]:
    """Set rigs to the rest pose, without animation; restore modifiers, pose, controls, animation and frame afterwards.

    In the block, time is not stretched, so frames of the scene are frames of the clips.

    Args:
        rigs: rigs of one armature object.
        clips: the clips that the yielded player will show.
        other_rigs: further rigs that the poses move, whose modifiers do not change.

    Yields:
        The player of the clips.
    """
    controlled_rigs = [(scene_rig, control_names(rig, channels)) for scene_rig, rig, channels in (*rigs, *other_rigs)]
    with ExitStack() as stack:
        player = stack.enter_context(clip_player(controlled_rigs, clips))
        stack.enter_context(hidden_comparison_objects())
        for scene_rig, _, _ in rigs:
            stack.enter_context(downstream_disabled(scene_rig.mesh_object))
        stack.enter_context(unstretched_time())
        for scene_rig, names in controlled_rigs:
            stack.enter_context(temporary_controls(scene_rig, names))
        yield player


def control_names(rig: Rig, channels: tuple[Channel, ...]) -> list[str]:
    """Return the names of the controls of a rig, and of further controls that random poses set."""
    sampled_controls = [channel.name for channel in channels if channel.kind == CONTROL]
    return list(dict.fromkeys([*(control.name for control in rig.controls), *sampled_controls]))
