# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses which bones of an armature are the joints of a rig, and finds the parent of each joint."""

from collections.abc import Iterable

import bpy
import numpy as np

from ..core.rig import STATIC_JOINT, Joint
from ..scene.scene_rig import SceneRig
from .dependencies import read_dependencies

COINCIDENCE_TOLERANCE = 1e-5
"""Largest distance between the ends of two bones that coincide at rest, as a fraction of their length."""


def choose_joints(
    scene_rig: SceneRig,
    weighted_bones: Iterable[str],
    extra_joints: Iterable[str] | None = None,
    are_joints_complete: bool = False,
) -> tuple[Joint, ...]:
    """Choose the joints of a rig; every parent comes before its children.

    The parent of a joint is its nearest ancestor that is a joint or that coincides with a joint: in a control rig the
    deforming bones are children of other bones, each of which coincides with a deforming bone.

    Args:
        scene_rig: the rig.
        weighted_bones: names of the bones that have weights, `STATIC_JOINT` among them; if there are no bones, all
            deforming bones.
        extra_joints: names of further joints; names that the armature lacks are ignored. If they include all joints,
            they define the order. By default: the bones on which the mesh depends in other ways, and all ancestors
            of joints.
        are_joints_complete: a mesh without weights gets no deforming bones besides `extra_joints`, which are the joints
            of a recording or a model.
    """
    armature_object = scene_rig.armature_object
    bones = armature_object.data.bones
    names = set(weighted_bones)
    extra_joints = None if extra_joints is None else list(extra_joints)
    if not names - {STATIC_JOINT} and not are_joints_complete:
        names |= {bone.name for bone in bones if bone.use_deform}
    if extra_joints is not None:
        names |= {name for name in extra_joints if name in bones or name == STATIC_JOINT}
    else:
        names |= read_dependencies(scene_rig).bones
        names |= {ancestor.name for name in names - {STATIC_JOINT} for ancestor in bones[name].parent_recursive}
    joint_bones = [bone for bone in bones if bone.name in names]
    parents = _parents(joint_bones)
    depths = {bone.name: _depth(bone.name, parents) for bone in joint_bones}
    ordered_names = sorted((bone.name for bone in joint_bones), key=depths.__getitem__)
    extra_order = [name for name in extra_joints or () if name != STATIC_JOINT]
    if set(extra_order) == set(ordered_names):
        # The order of an armature's bones changes when other bones are added.
        indices = {name: index for index, name in enumerate(extra_order)}
        if all(indices.get(parents[name], -1) < indices[name] for name in extra_order):
            ordered_names = extra_order
    indices = {name: index for index, name in enumerate(ordered_names)}
    joints = [Joint(name, indices[parents[name]] if parents[name] else -1) for name in ordered_names]
    return (*joints, *([Joint(STATIC_JOINT, -1)] if STATIC_JOINT in names else []))


def _parents(joint_bones: list[bpy.types.Bone]) -> dict[str, str]:
    """Find the parent joint of each joint, by name; empty for a root."""
    names = {bone.name for bone in joint_bones}
    bone_ends = np.array([[*bone.head_local, *bone.tail_local] for bone in joint_bones]).reshape(-1, 6)
    parents = {bone.name: _parent(bone, names, joint_bones, bone_ends) for bone in joint_bones}
    # Two coincident bones may each find the other as its parent. Then only ancestors in the armature count.
    if any(_depth(name, parents) > len(joint_bones) for name in parents):
        parents = {bone.name: _parent(bone, names, [], bone_ends[:0]) for bone in joint_bones}
    return parents


def _parent(bone: bpy.types.Bone, names: set[str], joint_bones: list[bpy.types.Bone], bone_ends: np.ndarray) -> str:
    """Find the parent joint of a joint."""
    for ancestor in bone.parent_recursive:
        if ancestor.name in names:
            return ancestor.name
        distances = np.abs(bone_ends - [*ancestor.head_local, *ancestor.tail_local]).max(axis=1, initial=0)
        for index in np.flatnonzero(distances <= COINCIDENCE_TOLERANCE * ancestor.length):
            if joint_bones[index] != bone:
                return joint_bones[index].name
    return ""


def _depth(name: str, parents: dict[str, str]) -> int:
    """Count the ancestors of a joint; if the parents form a cycle, the count is larger than the number of joints."""
    depth = 0
    while (name := parents[name]) and depth <= len(parents):
        depth += 1
    return depth
