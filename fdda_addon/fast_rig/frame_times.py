# SPDX-License-Identifier: GPL-3.0-or-later
"""Times the frames of a full rig and of its fast rig, by opening both files in turns."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import FDDAError
from ..core.progress import Progress
from ..poses.action_range import action_frames
from ..runtime.binding import model_disabled
from ..scene.blend_file import blender_path, report_message, silenced_stdout
from ..scene.scene_rig import find_rig
from ..scene.temporary_state import assign_action
from ..timing.benchmark import time_calls
from .controls import animating_actions
from .joint_poses import set_random_pose

ROUNDS = 3
WARM_UP_FRAMES = 3


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
    full: Path, fast: Path, object_name: str, controls: tuple[str, ...], frames: int, size: float
) -> Iterator[Progress | RigTimes]:
    """Time frames of both files in turns, as a generator that works while it is iterated; it leaves `fast` open.

    The files play an action that both have, or the same random poses where they have none.

    Args:
        full, fast: paths of the files.
        object_name: name of a mesh object of the rig.
        controls: names of the control bones that random poses move.
        frames: number of frames to time with each rig.
        size: size of the full rig, armature units.

    Yields:
        Progress, and at the end the RigTimes.

    Raises:
        FDDAError: a file cannot be opened.
    """
    times: dict[Path, list[float]] = {full: [], fast: []}
    frames_per_round = max(1, -(-frames // ROUNDS))
    for round_index in range(ROUNDS):
        for index, path in enumerate((full, fast)):
            times[path] += _time_file(path, object_name, controls, size, frames_per_round, round_index, path == full)
            yield Progress("frames", 2 * round_index + index + 1, 2 * ROUNDS)
    yield RigTimes(tuple(times[full]), tuple(times[fast]))


def _time_file(
    path: Path,
    object_name: str,
    controls: tuple[str, ...],
    size: float,
    count: int,
    round_index: int,
    shows_rig: bool,
) -> list[float]:
    try:
        with silenced_stdout():
            bpy.ops.wm.open_mainfile(filepath=blender_path(path), load_ui=False)
    except RuntimeError as error:
        raise FDDAError(f"Blender cannot open '{path}' ({report_message(error)}).") from error
    scene_rig = find_rig(object_name)
    armature_object = scene_rig.armature_object
    animation = armature_object.animation_data
    actions = animating_actions(armature_object)
    action = animation.action if animation and animation.action in actions else next(iter(actions), None)
    indices = range(round_index * count - WARM_UP_FRAMES, (round_index + 1) * count)
    if action is not None:
        assign_action(armature_object, action)
        frames = action_frames(action)
        calls = [_frame_setter(frames[index % len(frames)]) for index in indices]
    else:
        calls = [_pose_setter(armature_object, controls, size, index + WARM_UP_FRAMES) for index in indices]
    if not shows_rig:
        return time_calls(calls)[WARM_UP_FRAMES:]
    with model_disabled(scene_rig.mesh_object):
        return time_calls(calls)[WARM_UP_FRAMES:]


def _frame_setter(frame: int) -> Callable[[], None]:
    return lambda: bpy.context.scene.frame_set(frame)


def _pose_setter(
    armature_object: bpy.types.Object, controls: tuple[str, ...], size: float, seed: int
) -> Callable[[], None]:
    def show_pose() -> None:
        set_random_pose(armature_object, controls, size, seed)
        bpy.context.view_layer.update()

    return show_pose
