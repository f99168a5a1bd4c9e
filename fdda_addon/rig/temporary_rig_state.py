# SPDX-License-Identifier: GPL-3.0-or-later
"""All of a rig that posing it changes, borrowed at once; or of several that follow one armature."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

from ..core.poses import CONTROL, Channel
from ..core.rig import Rig
from ..poses.clip import Clip
from ..poses.clip_player import ClipPlayer, clip_actions, clip_player
from ..scene.armature import clear_pose
from ..scene.comparison import hidden_comparisons
from ..scene.controls import temporary_controls
from ..scene.scene_rig import SceneRig
from ..scene.temporary_state import temporary_pose
from .modifier_stack import downstream_disabled

Posed = tuple[SceneRig, Rig, tuple[Channel, ...]]
"""A rig, and the channels of the random poses that it will be brought to."""


@contextmanager
def temporary_rig_state(
    scene_rig: SceneRig, rig: Rig, channels: tuple[Channel, ...] = (), clips: tuple[Clip, ...] = ()
) -> Iterator[ClipPlayer]:
    """As `temporary_rig_states`, of one rig."""
    with temporary_rig_states([(scene_rig, rig, channels)], clips) as player:
        yield player


@contextmanager
def temporary_rig_states(
    rigs: Sequence[Posed], clips: tuple[Clip, ...] = (), beside: Sequence[Posed] = ()
) -> Iterator[ClipPlayer]:
    """Give back the modifiers, the pose, the controls, the animation and the frame. Inside, the rigs are at rest.

    Args:
        rigs: of one armature object.
        clips: that they will be posed by, with the player that is yielded.
        beside: rigs that the poses move too, whose modifiers stay as they are.

    Raises:
        RigError: a clip is to be mirrored, and a rig is not the same on both sides.
    """
    armature_object = rigs[0][0].armature_object
    controlled = [(scene_rig, control_names(rig, channels)) for scene_rig, rig, channels in (*rigs, *beside)]
    with ExitStack() as stack:
        player = stack.enter_context(clip_player(controlled, clips))
        stack.enter_context(hidden_comparisons())
        for scene_rig, _, _ in rigs:
            stack.enter_context(downstream_disabled(scene_rig.mesh_object))
        stack.enter_context(temporary_pose(armature_object, clip_actions(armature_object, clips)))
        for scene_rig, names in controlled:
            stack.enter_context(temporary_controls(scene_rig, names))
        clear_pose(armature_object)
        yield player


def control_names(rig: Rig, channels: tuple[Channel, ...]) -> list[str]:
    """Names of the controls that a rig has or that are sampled."""
    sampled = [channel.name for channel in channels if channel.kind == CONTROL]
    return list(dict.fromkeys([*(control.name for control in rig.controls), *sampled]))
