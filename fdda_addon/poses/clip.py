# SPDX-License-Identifier: GPL-3.0-or-later
"""Clips: pieces of animation whose whole frames are poses, actions and strips of an armature's NLA."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import bpy

from ..core.errors import RigError
from ..core.recording.index import ACTION, MIRRORED, STRIP, Source
from .action_range import action_frames


@dataclass(frozen=True)
class Clip:
    """A piece of animation.

    Attributes:
        kind: `ACTION` or `STRIP`.
        name: of the action or strip.
        frames: its whole frames, in the scene.
        is_mirrored: left and right are exchanged.
    """

    kind: str
    name: str
    frames: range
    is_mirrored: bool = False

    @property
    def title(self) -> str:
        """What a user reads."""
        return f"{self.name}, mirrored" if self.is_mirrored else self.name

    @property
    def source(self) -> Source:
        """What a recording says of it."""
        kind = MIRRORED if self.is_mirrored else self.kind
        return Source(kind, len(self.frames), self.name, (self.frames.start, 1))


def find_clips(
    armature_object: bpy.types.Object, actions: Iterable[str], strips: Iterable[str] = (), mirror: bool = False
) -> tuple[Clip, ...]:
    """Clips by the names of actions and strips, actions first.

    Args:
        armature_object: whose NLA has the strips.
        actions, strips: names.
        mirror: each clip a second time, mirrored, right after the first.

    Raises:
        RigError: there is none of a name, or a strip is muted.
    """
    clips = [Clip(ACTION, name, action_frames(find_action(name))) for name in actions]
    clips += [Clip(STRIP, name, _strip_frames(find_strip(armature_object, name))) for name in strips]
    if mirror:
        clips = [each for clip in clips for each in (clip, replace(clip, is_mirrored=True))]
    return tuple(clips)


def find_action(name: str) -> bpy.types.Action:
    """An action of the file by its name.

    Raises:
        RigError: there is none of this name.
    """
    action = bpy.data.actions.get(name)
    if action is None:
        known = ", ".join(f"'{a.name}'" for a in bpy.data.actions) or "none"
        raise RigError(f"The file has no action '{name}'; its actions: {known}.")
    return action


def find_strip(armature_object: bpy.types.Object, name: str) -> bpy.types.NlaStrip:
    """A strip of an armature's NLA by its name.

    Raises:
        RigError: there is none of this name, or it is muted.
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
    known = ", ".join(f"'{strip.name}'" for _, strip in strips) or "none"
    raise RigError(f"The NLA of '{armature_object.name}' has no strip '{name}'; its strips: {known}.")


def _strip_frames(strip: bpy.types.NlaStrip) -> range:
    """The whole frames that a strip covers."""
    return range(math.ceil(strip.frame_start), math.floor(strip.frame_end) + 1)
