# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures what a fast rig would save, also for a character without a model."""

from pathlib import Path

import bpy
import numpy as np

from ..core.errors import RigError
from ..core.files.temporary import temporary_folder
from ..core.progress import Job
from ..core.rig import STATIC_JOINT
from ..rig.dependencies import read_dependencies
from ..rig.modifier_stack import check_evaluable
from ..runtime.binding import unbind
from ..scene.blend_file import save_copy
from ..scene.scene_rig import SceneRig, armature_modifier, armature_of
from ..scene.skin import read_skin
from ..timing.durations import Duration
from ..timing.fast_rig_saving import FastRigSaving
from .compared_poses import rig_size
from .controls import VISIBLE, control_bones
from .frame_times import measure_frames
from .removal import remove_unneeded

ROUNDS, FRAMES_PER_ROUND = 5, 12
"""Each round opens both files, and measures them one after the other."""


def measure_saving(scene_rig: SceneRig, file: Path) -> Job[FastRigSaving]:
    """Time a rig, and a copy without what its visible controls and its joints do not need.

    The joints are the bones with weights on the mesh, and those that deform it in other ways. The open file is changed
    and replaced by others, so run this in a process of its own.

    Args:
        file: the open file, as it is saved.

    Raises:
        FDDAError: a model cannot replace the modifiers, bones cannot be removed, or a file cannot be written or opened.
    """
    mesh_object, armature_object = scene_rig.mesh_object, scene_rig.armature_object
    if mesh_object.fdda.is_fast_rig:
        raise RigError(f"'{mesh_object.name}' is a fast rig already; open the file of the full rig.")
    for scene_object in bpy.context.scene.objects:
        if scene_object.type == "MESH" and scene_object.fdda.is_bound and armature_of(scene_object) == armature_object:
            unbind(scene_object)
    check_evaluable(scene_rig)
    joints = _joint_names(scene_rig)
    controls = tuple(sorted(control_bones(armature_object, (VISIBLE,))))
    object_name, size, vertex_count = mesh_object.name, rig_size(armature_object), len(mesh_object.data.vertices)
    bone_count = len(armature_object.data.bones)
    remove_unneeded([scene_rig], joints, controls)
    kept_count = len(armature_object.data.bones)
    with temporary_folder() as folder:
        pruned_file = folder / "pruned.blend"
        save_copy(pruned_file)
        frames = ROUNDS * FRAMES_PER_ROUND
        times = yield from measure_frames(file, pruned_file, object_name, controls, frames, size, ROUNDS)
    full, pruned = (
        Duration.of([float(np.median(round_times)) for round_times in np.split(np.array(all_times), ROUNDS)])
        for all_times in (times.full, times.fast)
    )
    return FastRigSaving(vertex_count, bone_count, kept_count, len(joints), len(controls), full, pruned)


def _joint_names(scene_rig: SceneRig) -> set[str]:
    """Return the names of the bones that deform a mesh; all deforming bones if none has a weight."""
    armature_object = scene_rig.armature_object
    skin = read_skin(scene_rig.mesh_object, armature_object, armature_modifier(scene_rig.mesh_object))
    names = {*skin.bones, *read_dependencies(scene_rig).bones} - {STATIC_JOINT}
    return names or {bone.name for bone in armature_object.data.bones if bone.use_deform}
