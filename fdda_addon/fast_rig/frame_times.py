# SPDX-License-Identifier: GPL-3.0-or-later
"""Times the frames of a full rig and of its fast rig, by opening both files in turns; also without models."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import FDDAError, RigError
from ..core.files.temporary import temporary_folder
from ..core.progress import Job, Progress
from ..poses.action_range import action_frames
from ..runtime.binding import model_disabled, unbind
from ..scene.action_slots import dependencies, slots_of_action
from ..scene.blend_file import blender_path, report_message, save_copy, silenced_stdout
from ..scene.scene_rig import check_full_rig, find_rig, rigs_of_armature
from ..scene.temporary_state import assign_action
from ..scene.time_stretching import unstretched_time
from ..timing.benchmark import untrained_models
from ..timing.durations import WARM_UP_FRAMES, time_calls
from ..timing.frame_profile import FastRigSaving
from .compared_poses import rig_size, set_random_pose
from .controls import VISIBLE, animating_actions, control_bones
from .run import bind_packed_models, remove_unneeded_parts

ROUNDS = 3


@dataclass(frozen=True)
class RigTimes:
    """Times of a frame of both rigs, in milliseconds, in the order in which they were measured.

    Attributes:
        full, fast: times with the full rig and its modifiers, and with the fast rig and its model.
    """

    full: tuple[float, ...]
    fast: tuple[float, ...]

    @property
    def ratio(self) -> float:
        """Return how many times faster a frame is with the fast rig, by medians."""
        return float(np.median(self.full) / np.median(self.fast))

    @property
    def sentence(self) -> str:
        """Return the medians with the ranges from the 10th to the 90th percentile."""
        full, fast = (
            f"{np.median(times):.2f} ms ({np.percentile(times, 10):.2f} to {np.percentile(times, 90):.2f})"
            for times in (self.full, self.fast)
        )
        return f"a frame took {full} with the full rig, {fast} with the fast rig: {self.ratio:.1f} times as fast"


def measure_frames(
    full: Path,
    fast: Path,
    object_name: str,
    controls: tuple[str, ...],
    frames: int,
    size: float,
    rounds: int = ROUNDS,
) -> Job[RigTimes]:
    """Time frames of both files in turns while the generator is iterated; leave `fast` open.

    The files play an action that both have, or the same random poses where they have none.

    Args:
        full, fast: paths of the files.
        object_name: name of a mesh object of the rig.
        controls: names of the control bones that random poses move.
        frames: number of frames to time with each rig.
        size: size of the full rig, armature units.
        rounds: number of rounds; each opens both files.
    """
    times: dict[Path, list[float]] = {full: [], fast: []}
    frames_per_round = max(1, -(-frames // rounds))
    action_name = None
    for round_index in range(rounds):
        # The fast rig first: the full rig may have further actions, which key only removed bones.
        for index, path in enumerate((fast, full)):
            try:
                with silenced_stdout():
                    bpy.ops.wm.open_mainfile(filepath=blender_path(path), load_ui=False)
            except RuntimeError as error:
                raise FDDAError(f"Blender cannot open '{path}' ({report_message(error)}).") from error
            armature_object = find_rig(object_name).armature_object
            if action_name is None:
                # The assigned action, or the first that keys bones.
                animation, actions = armature_object.animation_data, animating_actions(armature_object)
                action = animation.action if animation and animation.action in actions else next(iter(actions), None)
                action_name = action.name if action else ""
            indices = range(round_index * frames_per_round - WARM_UP_FRAMES, (round_index + 1) * frames_per_round)
            meshes = [o for o in bpy.context.scene.objects if o.type == "MESH" and o.fdda.is_bound and path == full]
            with unstretched_time(), model_disabled(*meshes):
                times[path] += time_calls(_frame_calls(armature_object, action_name, controls, size, indices))
            yield Progress("frames", 2 * round_index + index + 1, 2 * rounds)
    return RigTimes(tuple(times[full]), tuple(times[fast]))


def _frame_calls(
    armature_object: bpy.types.Object, action_name: str, controls: tuple[str, ...], size: float, indices: range
) -> Iterator[Callable[[], object]]:
    """Yield functions that show frames of an action, or random poses if its name is empty; one for each index."""
    if not action_name:
        for index in indices:
            set_random_pose(armature_object, controls, size, index + WARM_UP_FRAMES)
            yield bpy.context.view_layer.update
        return
    action = bpy.data.actions[action_name]
    for datablock, slot in slots_of_action(action, dependencies(armature_object)).items():
        assign_action(datablock, action, slot)
    frames = action_frames(action)
    for index in indices:
        yield partial(bpy.context.scene.frame_set, frames[index % len(frames)])


SAVING_ROUNDS, FRAMES_PER_ROUND = 5, 12
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
        frames = SAVING_ROUNDS * FRAMES_PER_ROUND
        times = yield from measure_frames(file, fast_file, object_name, controls, frames, size, SAVING_ROUNDS)
    medians = (round(float(np.median(each)), 4) for each in (times.full, times.fast))
    return FastRigSaving(bone_count, kept_count, len(joints), len(controls), *medians)
