# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures what a fast rig would save, also for a character without models."""

from pathlib import Path

import bpy
import numpy as np

from ..core.errors import RigError
from ..core.files.temporary import temporary_folder
from ..core.progress import Job
from ..runtime.binding import unbind
from ..scene.blend_file import save_copy
from ..scene.scene_rig import check_full_rig, rigs_of_armature
from ..timing.frame_profile import FastRigSaving
from ..timing.untrained_models import untrained_models
from .compared_poses import rig_size
from .controls import VISIBLE, control_bones
from .frame_times import measure_frames
from .run import bind_packed_models, remove_unneeded_parts

ROUNDS, FRAMES_PER_ROUND = 5, 12
"""Each round opens both files, and measures them one after the other."""


def measure_saving(armature_object: bpy.types.Object, file: Path) -> Job[FastRigSaving]:
    """Time a rig, and a fast rig of it whose meshes play untrained models.

    The fast rig keeps the visible bones, and what the meshes need that no model can deform. The open file is changed
    and replaced by others, so run this in a process of its own.

    Args:
        armature_object: the armature of the rig.
        file: the open file, as it is saved.

    Raises:
        FDDAError: no mesh can have a model, bones cannot be removed, or a file cannot be written or opened.
    """
    rigs = rigs_of_armature(armature_object)
    for scene_rig in rigs:
        check_full_rig(scene_rig.mesh_object)
        unbind(scene_rig.mesh_object)
    bone_count, controls = len(armature_object.data.bones), tuple(sorted(control_bones(armature_object, (VISIBLE,))))
    with temporary_folder() as folder, untrained_models(rigs) as (models, reasons):
        if not models:
            raise RigError(next(iter(reasons.values())))
        rigs_and_models = [(rig, models[rig.mesh_object]) for rig in rigs if rig.mesh_object in models]
        joints = bind_packed_models(rigs_and_models)
        remove_unneeded_parts([rig for rig, _ in rigs_and_models], joints, controls)
        kept_count, size = len(armature_object.data.bones), rig_size(armature_object)
        object_name, fast_file = rigs_and_models[0][0].mesh_object.name, folder / "fast.blend"
        save_copy(fast_file)
        frames = ROUNDS * FRAMES_PER_ROUND
        times = yield from measure_frames(file, fast_file, object_name, controls, frames, size, ROUNDS)
    medians = (round(float(np.median(each)), 4) for each in (times.full, times.fast))
    return FastRigSaving(bone_count, kept_count, len(joints), len(controls), *medians)
