# SPDX-License-Identifier: GPL-3.0-or-later
"""All of a rig that posing it changes, borrowed at once."""

from collections.abc import Iterator
from contextlib import contextmanager

from ..core.poses import CONTROL, Channel
from ..core.rig import Rig
from .armature import clear_pose
from .borrow import borrowed_pose
from .clip import Clip
from .clip_player import ClipPlayer, clip_actions, played_clips
from .controls import borrowed_controls
from .modifier_stack import borrowed_stack
from .scene_rig import SceneRig


@contextmanager
def borrowed_rig(
    scene_rig: SceneRig, rig: Rig, channels: tuple[Channel, ...] = (), clips: tuple[Clip, ...] = ()
) -> Iterator[ClipPlayer]:
    """Give back the modifiers, the pose, the controls, the animation and the frame. Inside, the rig is at rest.

    Args:
        scene_rig, rig: the rig.
        channels: of the random poses that it will be brought to.
        clips: that it will be posed by, with the player that is yielded.

    Raises:
        RigError: a clip is to be mirrored, and the rig is not the same on both sides.
    """
    controls = control_names(rig, channels)
    with (
        played_clips(scene_rig, clips, controls) as player,
        borrowed_stack(scene_rig.mesh_object),
        borrowed_pose(scene_rig.armature_object, clip_actions(scene_rig, clips)),
        borrowed_controls(scene_rig, controls),
    ):
        clear_pose(scene_rig.armature_object)
        yield player


def control_names(rig: Rig, channels: tuple[Channel, ...]) -> list[str]:
    """Names of the controls that a rig has or that are sampled."""
    sampled = [channel.bone for channel in channels if channel.kind == CONTROL]
    return list(dict.fromkeys([*(control.name for control in rig.controls), *sampled]))
