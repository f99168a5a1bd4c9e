# SPDX-License-Identifier: GPL-3.0-or-later
"""Clip: an action, or a strip of the NLA, whose whole frames are used as poses."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import bpy

from ..core.errors import RigError
from ..core.recording.index import ACTION, MIRRORED, STRIP, Source
from ..scene.action_slots import dependencies, slots_of_action, unmuted_curves
from ..scene.compatibility import animation_curves
from ..scene.scene_rig import SceneRig
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
    scene_rigs: Sequence[SceneRig], actions: Iterable[str], strips: Iterable[str] = (), mirror: bool = False
) -> tuple[Clip, ...]:
    """Find clips by the names of actions and strips, actions first.

    Args:
        scene_rigs: the rigs that the clips animate.
        actions, strips: names.
        mirror: add each clip a second time, mirrored, right after the first.

    Raises:
        RigError: there is no action or strip of a name, it animates nothing of the rigs, or a strip is muted.
    """
    roots = [scene_rigs[0].armature_object, *(o for scene_rig in scene_rigs for o in scene_rig.mesh_objects)]
    actions, strips = list(actions), list(strips)
    datablocks = dependencies(*roots) if actions or strips else []
    clips = []
    for name in actions:
        action = find_action(name)
        if not slots_of_action(action, datablocks):
            identifiers = ", ".join(f"'{slot.identifier}'" for slot in action.slots)
            reason = f"its slots are for something else: {identifiers}"
            if not animation_curves(action):
                reason = "it has no F-curves"
            elif not any(unmuted_curves(action, slot) for slot in action.slots):
                reason = "its F-curves are muted"
            raise RigError(
                f"The action '{name}' animates neither '{roots[0].name}' nor anything that moves '{roots[1].name}': "
                f"{reason}; choose another action, or assign it to the object that it animates."
            )
        clips.append(Clip(ACTION, name, action_frames(action)))
    clips += [Clip(STRIP, name, _strip_frames(find_strip(datablocks, name))) for name in strips]
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


def find_strip(datablocks: Sequence[bpy.types.ID], name: str) -> bpy.types.NlaStrip:
    """Find a strip by its name in the NLA of the datablocks of a rig, of which the first is the armature object.

    Raises:
        RigError: there is no such strip, it is muted, or several have the name and other frames.
    """
    animations = [animation for d in datablocks if (animation := getattr(d, "animation_data", None)) is not None]
    strips = [(track, strip) for animation in animations for track in animation.nla_tracks for strip in track.strips]
    named_strips = [(track, strip) for track, strip in strips if strip.name == name]
    shown_strips = [strip for track, strip in named_strips if not (strip.mute or track.mute)]
    if not named_strips:
        names = ", ".join(sorted({f"'{strip.name}'" for _, strip in strips})) or "none"
        raise RigError(f"The NLA of '{datablocks[0].name}' has no strip '{name}'; its strips: {names}.")
    if not shown_strips:
        track, strip = named_strips[0]
        raise RigError(
            f"The strip '{name}' of '{strip.id_data.name}' is muted and shows nothing; unmute it and its track "
            f"'{track.name}'."
        )
    owners = {_strip_frames(strip): strip.id_data.name for strip in shown_strips}
    if len(owners) > 1:
        names = " and ".join(f"'{owner}'" for owner in owners.values())
        raise RigError(f"{names} have strips '{name}' with different frames; rename one of them.")
    return shown_strips[0]


def _strip_frames(strip: bpy.types.NlaStrip) -> range:
    """Return the whole frames that a strip covers."""
    return range(math.ceil(strip.frame_start), math.floor(strip.frame_end) + 1)
