# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits the skin weights of linear skinning to poses of a rig, in the trainer's Python."""

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

MAX_POSES = 300
MAX_BYTES = 256 << 20
"""Weights are fitted to at most this number of poses, and to at most this many bytes of positions."""
WAIT_SECONDS = 0.02
"""How long a step waits for the process: a job of the sidebar goes on drawing meanwhile."""


class SkinFitting(TrainerProcess):
    """A fit of skin weights in a process of its own; its arguments are those of `trainer.skin_fit`."""

    module = "trainer.skin_fit"
    failed = "The skin weights could not be fitted."
    lost = "no skin weights were fitted, record again"


def poses_to_fit(total: int, vertices: int) -> list[int]:
    """Which of the `total` poses of a recording weights are fitted to: spread over all of them.

    Raises:
        RecordingError: there are too few.
    """
    if total < MIN_POSES:
        raise RecordingError(
            f"Skin weights are fitted to at least {MIN_POSES} poses, and these are {total}; record more, or leave "
            "--fit-linear out."
        )
    count = min(total, MAX_POSES, max(MIN_POSES, MAX_BYTES // (12 * vertices)))
    return np.linspace(0, total - 1, count).round().astype(int).tolist()


def fit_weights(rig: Rig, kind: str, poses: Iterator[None], count: int, evaluator: PoseEvaluator) -> Iterator[Progress]:
    """Fit the weights of a rig to poses.

    Args:
        rig: with the weights of its own.
        kind: one of `core.skin_fit.KINDS`.
        poses: poses the scene, one pose an iteration.
        count: number of poses.
        evaluator: of the scene.

    Returns:
        The rig with the fitted weights, its fingerprint as before; and the SkinFit.

    Raises:
        TrainingError: the trainer's Python cannot fit.
        OutputError: there is no room for the poses.
    """
    try:
        # On Windows a virus scanner may still read what is to be removed.
        temporary = tempfile.TemporaryDirectory(prefix="fdda-fit-", ignore_cleanup_errors=True)
    except OSError as error:
        raise temporary_folder_error(error) from error
    with temporary as name:
        folder = Path(name)
        with FitPosesWriter(folder, rig, count) as writer:
            for number, _ in enumerate(poses, 1):
                pose_matrices, positions, *_ = evaluator.evaluate()
                writer.append(pose_matrices, positions)
                yield Progress("poses to fit", number, count)
        fit = yield from _fit_folder(folder, kind, rig)
        joints, weights = read_fitted_weights(folder, rig)
    return replace(rig, skin_joints=joints, skin_weights=weights), fit


def _fit_folder(folder: Path, kind: str, rig: Rig) -> Iterator[Progress]:
    """Yields progress, returns the SkinFit."""
    progress, vertices = Progress("fit", 0, rig.vertex_count), rig.vertex_count
    with SkinFitting([str(folder), kind, "--metres-per-unit", repr(rig.metres_per_unit)]) as fitting:
        for message in fitting.messages(wait=False):
            if message is None:
                time.sleep(WAIT_SECONDS)
            elif message.type is MessageType.PROGRESS:
                progress = Progress("fit", int(message.values["done"]), vertices)
            elif message.type is MessageType.FINISHED:
                return SkinFit.from_json(message.values["fit"])
            yield progress
    raise TrainingError("The fit of the skin weights was ended from outside; record again.")


def check_has_weights(scene_rig: SceneRig, rig: Rig) -> None:
    """Fail where linear skinning with the rig's own weights would never move.

    Raises:
        RigError: no vertex follows a bone.
    """
    names = {rig.joint_names[joint] for joint in np.unique(rig.skin_joints[rig.skin_weights > 0])}
    if names <= {STATIC_JOINT}:
        raise RigError(
            f"The vertices of '{scene_rig.mesh_object.name}' have no weights on deforming bones of "
            f"'{scene_rig.armature_object.name}', so there is no linear skinning to learn from; have one fitted "
            "(--fit-linear smooth, or Base Skinning in the sidebar), or paint weights."
        )
