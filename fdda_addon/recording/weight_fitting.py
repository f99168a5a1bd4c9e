# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits skin weights to poses of a rig, and chooses key joints, in the trainer's Python."""

import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..core.errors import RecordingError, RigError, TrainingError
from ..core.files.temporary import temporary_folder
from ..core.formats.messages import MessageType
from ..core.joint_option import ALL, KEY_JOINTS_STAGE
from ..core.mathematics.key_joints import KeyJointReport
from ..core.mathematics.poses import CONTROL, Channel
from ..core.mathematics.skin_fit import DEFAULT_KIND, SkinFit
from ..core.progress import Progress
from ..core.recording.fit_folder import MIN_POSES, FitPosesWriter, read_fitted_weights, read_key_joints
from ..core.rig import STATIC_JOINT, Rig
from ..rig.dependencies import read_dependencies
from ..rig.reading import PoseEvaluator, read_key_joints_rig
from ..scene.scene_rig import SceneRig, armature_modifier
from ..training.process import TrainerProcess
from .plan import RecordingSettings

MAX_FIT_POSES = 300
MAX_FIT_BYTES = 256 << 20
"""Largest number of poses to which weights are fitted, and largest size of their positions, unless that is less than
the smallest number of poses."""
MIN_RANDOM_POSES = 40
"""Smallest number of random poses by which key joints are chosen."""
WAIT_SECONDS = 0.02
"""Pause while waiting for the process, during which the sidebar stays responsive."""


class SkinFitting(TrainerProcess):
    """Process that fits skin weights; its arguments are those of `trainer.skin`."""

    module = "trainer.skin"
    failure_message = "The skin weights could not be fitted."
    loss_advice = "no skin weights were fitted, record again"


def choose_fit_poses(pose_count: int, vertex_count: int, random_count: int = 0) -> list[int]:
    """Choose evenly spaced poses of a recording to fit weights to, and return their ascending indices.

    Args:
        pose_count: number of poses of the recording.
        vertex_count: number of vertices.
        random_count: number of random poses, the first of the recording, if key joints are chosen: two thirds of the
            chosen poses are random. 0 to choose among all poses.

    Raises:
        RecordingError: there are too few poses.
    """
    if pose_count < MIN_POSES:
        raise RecordingError(
            f"Skin weights are fitted to at least {MIN_POSES} poses, and these are {pose_count}; record more, or leave "
            "--fit-linear out."
        )
    min_pose_count = 3 * MIN_RANDOM_POSES // 2 if random_count else MIN_POSES
    fit_pose_count = min(pose_count, MAX_FIT_POSES, max(min_pose_count, MAX_FIT_BYTES // (12 * vertex_count)))
    chosen_random_count = min(random_count, max(2 * fit_pose_count // 3, fit_pose_count - (pose_count - random_count)))
    parts = ((0, random_count, chosen_random_count), (random_count, pose_count, fit_pose_count - chosen_random_count))
    return [
        index
        for start, end, count in parts
        for index in np.linspace(start, end - 1, min(count, end - start)).round().astype(int).tolist()
    ]


@dataclass(frozen=True)
class FitRequest:
    """What is fitted.

    Attributes:
        kind: one of `core.mathematics.skin_fit.FIT_KINDS`; empty to fit weights only if joints are removed.
        joints: the option `joints`.
        poses: indices of the poses of the fit in the recording, ascending.
        random_count: number of these poses that are random; key joints are chosen by these.
        dependencies: names of joints that move the mesh otherwise than by skin weights.
        sampled: names of bones that random poses move.
    """

    kind: str
    joints: str
    poses: list[int]
    random_count: int = 0
    dependencies: frozenset[str] = frozenset()
    sampled: frozenset[str] = frozenset()

    @property
    def has_key_joints(self) -> bool:
        """Return whether key joints are chosen."""
        return self.joints != ALL


def make_fit_request(
    scene_rig: SceneRig, rig: Rig, settings: RecordingSettings, channels: tuple[Channel, ...], pose_count: int
) -> FitRequest:
    """Make the request of a fit with the settings of a recording.

    Args:
        scene_rig, rig: the rig.
        settings: settings of the recording.
        channels: channels of the random poses.
        pose_count: number of poses of the recording.

    Raises:
        RecordingError: there are too few poses.
    """
    if settings.joints == ALL:
        return FitRequest(settings.fit_linear, ALL, choose_fit_poses(pose_count, rig.vertex_count))
    # Frames of actions do not show which joints can move independently.
    if settings.poses < MIN_RANDOM_POSES:
        raise RecordingError(
            f"Key joints are chosen by at least {MIN_RANDOM_POSES} random poses, and these are {settings.poses}; "
            "record more (--poses), or leave --joints out."
        )
    poses = choose_fit_poses(pose_count, rig.vertex_count, settings.poses)
    random_count = sum(index < settings.poses for index in poses)
    dependencies = frozenset(rig.joint_names) if settings.target.name else read_dependencies(scene_rig).bones
    sampled = frozenset(channel.name for channel in channels if channel.kind != CONTROL)
    return FitRequest(settings.fit_linear, settings.joints, poses, random_count, dependencies, sampled)


@dataclass(frozen=True)
class FittedWeights:
    """The skin weights of linear skinning.

    Attributes:
        rig: the rig with these weights, and with key joints alone if joints were removed.
        fit: result of the fit; None if the weights are the rig's own.
        needed_inputs: (V, J + C) bool, key joints and controls from which the motion of removed joints at each vertex
            follows; None if no joints were removed.
    """

    rig: Rig
    fit: SkinFit | None
    needed_inputs: np.ndarray | None = None


def fit_weights(
    scene_rig: SceneRig, rig: Rig, request: FitRequest, poses: Iterator[object], evaluator: PoseEvaluator
) -> Generator[Progress, None, FittedWeights]:
    """Fit the weights of a rig to poses.

    Args:
        scene_rig, rig: the rig with its own skin weights.
        request: what is fitted.
        poses: iterator that sets one pose per iteration.
        evaluator: evaluator of the poses.

    Yields:
        Progress of the stages "poses to fit", "key joints" if these are chosen, and "fit". It has a note if no joint
        can be removed.

    Raises:
        RigError: the weights of the rig are needed, and there are none.
        TrainingError: the trainer's Python cannot fit the weights.
        OutputError: the poses cannot be written.
    """
    with temporary_folder("fdda-fit-") as folder:
        with FitPosesWriter(folder, rig, len(request.poses), request.dependencies, request.sampled) as writer:
            for pose_number, _ in enumerate(poses, 1):
                writer.append(*evaluator.evaluate())
                yield Progress("poses to fit", pose_number, len(request.poses))
        result = yield from _run_fit(folder, rig, request)
        if isinstance(result, KeyJointReport):
            yield Progress("fit", rig.vertex_count, rig.vertex_count, result.sentence())
            if not request.kind:
                check_has_weights(scene_rig, rig)
                return FittedWeights(rig, None)
            result = yield from _run_fit(folder, rig, replace(request, joints=ALL))
        joints, weights = read_fitted_weights(folder, rig)
        if not result.key_joints:
            return FittedWeights(replace(rig, skin_joints=joints, skin_weights=weights), result)
        key_joints, needed_inputs = read_key_joints(folder, rig)
    key_names = [rig.joint_names[joint] for joint in key_joints]
    key_rig = read_key_joints_rig(scene_rig, rig, key_names)
    # Without the removed joints, others may be nearer to the root and come earlier.
    new_indices = [key_rig.joint_names.index(name) for name in key_names]
    indices = np.zeros(len(rig.joints), np.int32)
    indices[key_joints] = new_indices
    fitted_rig = replace(key_rig, skin_joints=indices[joints], skin_weights=weights)
    needed_inputs[:, new_indices] = needed_inputs[:, : len(key_names)].copy()
    return FittedWeights(fitted_rig, result, needed_inputs)


def _run_fit(folder: Path, rig: Rig, request: FitRequest) -> Generator[Progress, None, SkinFit | KeyJointReport]:
    """Run the process, yield its progress, and return its result: a report if no joint can be removed."""
    progress, vertex_count = Progress("fit", 0, rig.vertex_count), rig.vertex_count
    arguments = [str(folder), request.kind or DEFAULT_KIND, "--metres-per-unit", repr(rig.metres_per_unit)]
    if request.has_key_joints:
        static_joint = rig.joint_names.index(STATIC_JOINT) if STATIC_JOINT in rig.joint_names else -1
        arguments += ["--joints", request.joints, "--random-poses", str(request.random_count)]
        arguments += [f"--static-joint={static_joint}"]
    with SkinFitting(arguments) as fitting:
        for message in fitting.messages(wait=False):
            if message is None:
                time.sleep(WAIT_SECONDS)
            elif message.type is MessageType.PROGRESS:
                done = int(message.values["done"])
                progress = Progress("fit", done, vertex_count)
                if message.values.get("stage") == KEY_JOINTS_STAGE:
                    progress = Progress(KEY_JOINTS_STAGE, done, int(message.values["total"]))
            elif message.type is MessageType.FINISHED:
                return _read_result(message.values, rig)
            yield progress
    raise TrainingError("The fit of the skin weights was ended from outside; record again.")


def _read_result(values: dict, rig: Rig) -> SkinFit | KeyJointReport:
    """Read the result of the process, which names joints by their indices."""
    fit = SkinFit.from_json(values["fit"]) if values["fit"] else None
    report = fit.key_joints if fit else KeyJointReport.from_json(values["key_joints"])
    if report is not None:
        lost = {
            key: tuple(rig.joint_names[int(index)] for index in getattr(report, key))
            for key in ("independent", "still")
        }
        report = replace(report, **lost)
    return replace(fit, key_joints=report) if fit else report


def check_has_weights(scene_rig: SceneRig, rig: Rig) -> None:
    """Check that vertices of the rig have weights on deforming bones.

    Raises:
        RigError: there is no Armature modifier, or no vertex follows a bone.
    """
    mesh_object = scene_rig.mesh_object
    remedy = "have one fitted (--fit-linear smooth, or Base Skinning in the sidebar)"
    if armature_modifier(mesh_object) is None:
        raise RigError(
            f"'{mesh_object.name}' has no Armature modifier, so there is no linear skinning to learn from; {remedy}."
        )
    weighted_joints = {rig.joint_names[joint] for joint in np.unique(rig.skin_joints[rig.skin_weights > 0])}
    if weighted_joints <= {STATIC_JOINT}:
        raise RigError(
            f"The vertices of '{mesh_object.name}' have no weights on deforming bones of "
            f"'{scene_rig.armature_object.name}', so there is no linear skinning to learn from; {remedy}, or paint "
            "weights."
        )
