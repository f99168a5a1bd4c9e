# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds the reference joints of a rig in poses of its recording."""

from collections.abc import Collection
from contextlib import closing
from copy import copy

import bpy
import numpy as np

from ..core.mathematics.references import choose_references, has_reference_choice
from ..core.rig import Rig
from ..poses.clip_player import ClipPlayer
from ..rig.pose_setter import DIRECT_POSE_SETTER
from ..rig.reading import PoseReader
from ..rig.references import split_bone_path
from ..rig.sources import Sources
from ..scene.armature import clear_pose
from ..scene.scene_rig import SceneRig
from .pose_plan import PosePlan

MAX_POSES = 24
"""Largest number of random poses, and of frames of actions, in which the motions of joints are compared."""


def find_fixed_joints(scene_rig: SceneRig) -> set[str]:
    """Return the names of the bones that keep their parents as reference joints.

    What a driver reads of a bone without a parent is relative to the armature.
    """
    armature_object, read_bones = scene_rig.armature_object, set()
    sources = [Sources(scene_rig, mesh_object, follows_shape_keys=False) for mesh_object in scene_rig.mesh_objects]
    for _, curve in (owned_curve for each in sources for owned_curve in each.drivers.values()):
        for variable in curve.driver.variables:
            for target in (target for target in variable.targets if target.id == armature_object):
                is_number = variable.type == "SINGLE_PROP"
                name = split_bone_path(armature_object, target.data_path)[0] if is_number else target.bone_target
                bone = armature_object.pose.bones.get(name or "")
                if bone is not None and not bone.parent and variable.type in ("SINGLE_PROP", "TRANSFORMS"):
                    read_bones.add(bone.name)
    return read_bones


def find_references(
    scene_rig: SceneRig, rig: Rig, fixed_joints: Collection[str], plan: PosePlan, player: ClipPlayer
) -> Rig:
    """Return a rig with its reference joints (`core.mathematics.references`).

    Args:
        scene_rig, rig: the rig, prepared by `temporary_rig_state`.
        fixed_joints: result of `find_fixed_joints`.
        plan: plan of the poses.
        player: player of the clips of the plan.
    """
    armature_object = scene_rig.armature_object
    is_fixed = np.array([name in fixed_joints for name in rig.joint_names])
    if not has_reference_choice(rig, is_fixed):
        return rig
    # The joints follow a pose at once; only a simulated target does not.
    plan = copy(plan)
    plan.pose_setter = DIRECT_POSE_SETTER
    parts = (0, plan.random_count), (plan.random_count, plan.total)
    indices = {
        index
        for start, end in parts
        for index in np.linspace(start, end - 1, min(MAX_POSES, end - start)).round().astype(int).tolist()
    }
    reader, pose_matrices = PoseReader(scene_rig, rig.joint_names, rig.rest_matrices), []
    with closing(plan.show_poses(player, indices)) as poses:
        for _ in poses:
            depsgraph = bpy.context.evaluated_depsgraph_get()
            objects = (o.evaluated_get(depsgraph) for o in (scene_rig.mesh_object, armature_object))
            pose_matrices.append(reader.read(*objects))
    player.stop()
    clear_pose(armature_object)
    player.restore_numbers()
    return choose_references(rig, is_fixed, np.stack(pose_matrices))
