# SPDX-License-Identifier: GPL-3.0-or-later
"""Which bones of an armature are the joints of a rig, and which joint is the parent of which."""

from collections.abc import Iterable

import bpy
import numpy as np

from ..core.rig import STATIC_JOINT, Joint
from ..poses.sampling import default_channels
from ..scene.scene_rig import SceneRig
from .dependencies import read_dependencies

COINCIDENT = 1e-5
"""Bones whose ends lie no farther apart at rest coincide, as a part of their length."""


def choose_joints(
    scene_rig: SceneRig, skinning: Iterable[str], extra_joints: Iterable[str] | None = None
) -> tuple[Joint, ...]:
    """The joints of a rig, every parent before its children.

    The parent of a joint is the nearest bone above it that is a joint or lies where a joint lies: in a control rig the
    deforming bones are children of bones that others pose, each in the place of a deforming one.

    Args:
        scene_rig: the rig.
        skinning: names of the bones that have weights; all deforming bones when there are none. `STATIC_JOINT` counts.
        extra_joints: names of further joints; names that the armature lacks are ignored. If they include all joints,
            they define the order. None for the bones that have a range of motion, those that the mesh depends on in
            other ways, and all parents of joints.
    """
    armature_object = scene_rig.armature_object
    bones = armature_object.data.bones
    wanted = set(skinning)
    extra_joints = None if extra_joints is None else list(extra_joints)
    if not wanted - {STATIC_JOINT}:
        wanted |= {bone.name for bone in bones if bone.use_deform}
    if extra_joints is not None:
        wanted |= {name for name in extra_joints if name in bones or name == STATIC_JOINT}
    else:
        wanted |= {channel.name for channel in default_channels(armature_object, set())}
        wanted |= read_dependencies(scene_rig).bones
        wanted |= {above.name for name in wanted - {STATIC_JOINT} for above in bones[name].parent_recursive}
    own = [bone for bone in bones if bone.name in wanted]
    parents = _parents(own)
    depths = {bone.name: _depth(bone.name, parents) for bone in own}
    ordered = sorted((bone.name for bone in own), key=depths.__getitem__)
    given = [name for name in extra_joints or () if name != STATIC_JOINT]
    if set(given) == set(ordered):
        places = {name: place for place, name in enumerate(given)}
        if all(places.get(parents[name], -1) < places[name] for name in given):
            ordered = given
    index = {name: number for number, name in enumerate(ordered)}
    joints = [Joint(name, index[parents[name]] if parents[name] else -1) for name in ordered]
    return (*joints, *([Joint(STATIC_JOINT, -1)] if STATIC_JOINT in wanted else []))


def _parents(own: list[bpy.types.Bone]) -> dict[str, str]:
    """The parent joint of each joint by name, empty for a root."""
    names = {bone.name for bone in own}
    ends = np.array([[*bone.head_local, *bone.tail_local] for bone in own]).reshape(-1, 6)
    parents = {bone.name: _above(bone, names, own, ends) for bone in own}
    # Bones that lie in each other's place may each find the other: then only real ancestors count.
    if any(_depth(name, parents) > len(own) for name in parents):
        parents = {bone.name: _above(bone, names, [], ends[:0]) for bone in own}
    return parents


def _above(bone: bpy.types.Bone, names: set[str], own: list[bpy.types.Bone], ends: np.ndarray) -> str:
    for above in bone.parent_recursive:
        if above.name in names:
            return above.name
        apart = np.abs(ends - [*above.head_local, *above.tail_local]).max(axis=1, initial=0)
        for place in np.flatnonzero(apart <= COINCIDENT * above.length):
            if own[place] != bone:
                return own[place].name
    return ""


def _depth(name: str, parents: dict[str, str]) -> int:
    depth = 0
    while (name := parents[name]) and depth <= len(parents):
        depth += 1
    return depth
