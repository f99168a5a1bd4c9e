# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits skin weights to poses of a rig, in the trainer's Python."""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..core.errors import RecordingError, RigError, TrainingError
from ..core.messages import MessageType
from ..core.progress import Progress
from ..core.recording.fit_folder import MIN_POSES, FitPosesWriter, read_fitted_weights
from ..core.rig import STATIC_JOINT, Rig
from ..core.skin_fit import SkinFit
from ..core.temporary import temporary_folder_error
from ..rig.reading import PoseEvaluator
from ..scene.scene_rig import SceneRig
from ..training.process import TrainerProcess

MAX_FIT_POSES = 300
MAX_FIT_BYTES = 256 << 20
"""Largest number of poses to which weights are fitted, and largest size of their positions."""
WAIT_SECONDS = 0.02
"""Pause while waiting for the process, during which the sidebar stays responsive."""


class SkinFitting(TrainerProcess):
    """Process that fits skin weights; its arguments are those of `trainer.skin`."""

    module = "trainer.skin"
    failure_message = "The skin weights could not be fitted."
    loss_advice = "no skin weights were fitted, record again"


def choose_fit_poses(pose_count: int, vertex_count: int) -> list[int]:
    """Choose evenly spaced poses of a recording to fit weights to, and return their indices.

    Raises:
        RecordingError: there are too few poses.
    """
    if pose_count < MIN_POSES:
        raise RecordingError(
            f"Skin weights are fitted to at least {MIN_POSES} poses, and these are {pose_count}; record more, or leave "
            "--fit-linear out."
        )
    fit_pose_count = min(pose_count, MAX_FIT_POSES, max(MIN_POSES, MAX_FIT_BYTES // (12 * vertex_count)))
    return np.linspace(0, pose_count - 1, fit_pose_count).round().astype(int).tolist()


def fit_weights(
    rig: Rig, kind: str, poses: Iterator[None], pose_count: int, evaluator: PoseEvaluator
) -> Iterator[Progress]:
    """Fit the weights of a rig to poses.

    Args:
        rig: the rig with its own skin weights.
        kind: one of `core.skin_fit.FIT_KINDS`.
        poses: iterator that sets one pose per iteration.
        pose_count: number of poses.
        evaluator: evaluator of the poses.

    Returns:
        The rig with the fitted weights and its unchanged fingerprint, and the SkinFit.

    Raises:
        TrainingError: the trainer's Python cannot fit the weights.
        OutputError: the poses cannot be written.
    """
    try:
        # On Windows a virus scanner may still have a file open.
        temporary_folder = tempfile.TemporaryDirectory(prefix="fdda-fit-", ignore_cleanup_errors=True)
    except OSError as error:
        raise temporary_folder_error(error) from error
    with temporary_folder as folder_name:
        folder = Path(folder_name)
        with FitPosesWriter(folder, rig, pose_count) as writer:
            for pose_number, _ in enumerate(poses, 1):
                pose_matrices, positions, *_ = evaluator.evaluate()
                writer.append(pose_matrices, positions)
                yield Progress("poses to fit", pose_number, pose_count)
        fit = yield from _run_fit(folder, kind, rig)
        joints, weights = read_fitted_weights(folder, rig)
    return replace(rig, skin_joints=joints, skin_weights=weights), fit


def _run_fit(folder: Path, kind: str, rig: Rig) -> Iterator[Progress]:
    """Run the process, yield its progress, and return the SkinFit."""
    progress, vertex_count = Progress("fit", 0, rig.vertex_count), rig.vertex_count
    with SkinFitting([str(folder), kind, "--metres-per-unit", repr(rig.metres_per_unit)]) as fitting:
        for message in fitting.messages(wait=False):
            if message is None:
                time.sleep(WAIT_SECONDS)
            elif message.type is MessageType.PROGRESS:
                progress = Progress("fit", int(message.values["done"]), vertex_count)
            elif message.type is MessageType.FINISHED:
                return SkinFit.from_json(message.values["fit"])
            yield progress
    raise TrainingError("The fit of the skin weights was ended from outside; record again.")


def check_has_weights(scene_rig: SceneRig, rig: Rig) -> None:
    """Check that vertices of the rig have weights on deforming bones.

    Raises:
        RigError: no vertex follows a bone.
    """
    weighted_joints = {rig.joint_names[joint] for joint in np.unique(rig.skin_joints[rig.skin_weights > 0])}
    if weighted_joints <= {STATIC_JOINT}:
        raise RigError(
            f"The vertices of '{scene_rig.mesh_object.name}' have no weights on deforming bones of "
            f"'{scene_rig.armature_object.name}', so there is no linear skinning to learn from; have one fitted "
            "(--fit-linear smooth, or Base Skinning in the sidebar), or paint weights."
        )
