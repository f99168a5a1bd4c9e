# SPDX-License-Identifier: GPL-3.0-or-later
"""Clip: an action, or a strip of an armature's NLA, whose whole frames are used as poses."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import bpy

from ..core.errors import RigError
from ..core.recording.index import ACTION, MIRRORED, STRIP, Source
from .action_range import action_frames


@dataclass(frozen=True)
class Clip:
    """An action or an NLA strip whose frames are used as poses.

    Attributes:
        kind: `ACTION` or `STRIP`.
        name: name of the action or strip.
        frames: the whole frames of the clip, in scene time.
        is_mirrored: the poses of the clip are mirrored left to right.
    """

    kind: str
    name: str
    frames: range
    is_mirrored: bool = False

    @property
    def title(self) -> str:
        """Return the title for users."""
        return f"{self.name}, mirrored" if self.is_mirrored else self.name

    @property
    def source(self) -> Source:
        """Return the description of the clip in a recording."""
        kind = MIRRORED if self.is_mirrored else self.kind
        return Source(kind, len(self.frames), self.name, (self.frames.start, 1))


def find_clips(
    armature_object: bpy.types.Object, actions: Iterable[str], strips: Iterable[str] = (), mirror: bool = False
) -> tuple[Clip, ...]:
    """Find clips by the names of actions and strips, actions first.

    Args:
        armature_object: the armature object with the strips in its NLA.
        actions, strips: names.
        mirror: add each clip a second time, mirrored, right after the first.

    Raises:
        RigError: there is no action or strip of a name, or a strip is muted.
    """
    clips = [Clip(ACTION, name, action_frames(find_action(name))) for name in actions]
    clips += [Clip(STRIP, name, _strip_frames(find_strip(armature_object, name))) for name in strips]
    if mirror:
        clips = [version for clip in clips for version in (clip, replace(clip, is_mirrored=True))]
    return tuple(clips)


def find_action(name: str) -> bpy.types.Action:
    """Find an action of the file by its name.

    Raises:
        RigError: there is no such action.
    """
    action = bpy.data.actions.get(name)
    if action is None:
        names = ", ".join(f"'{a.name}'" for a in bpy.data.actions) or "none"
        raise RigError(f"The file has no action '{name}'; its actions: {names}.")
    return action


def find_strip(armature_object: bpy.types.Object, name: str) -> bpy.types.NlaStrip:
    """Find a strip of an armature's NLA by its name.

    Raises:
        RigError: there is no such strip, or it is muted.
    """
    animation = armature_object.animation_data
    strips = [(track, strip) for track in (animation.nla_tracks if animation else ()) for strip in track.strips]
    for track, strip in strips:
        if strip.name == name:
            if strip.mute or track.mute:
                raise RigError(
                    f"The strip '{name}' of '{armature_object.name}' is muted and shows nothing; unmute it and its "
                    f"track '{track.name}'."
                )
            return strip
    names = ", ".join(f"'{strip.name}'" for _, strip in strips) or "none"
    raise RigError(f"The NLA of '{armature_object.name}' has no strip '{name}'; its strips: {names}.")


def _strip_frames(strip: bpy.types.NlaStrip) -> range:
    """Return the whole frames that a strip covers."""
    return range(math.ceil(strip.frame_start), math.floor(strip.frame_end) + 1)
