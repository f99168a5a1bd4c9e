# SPDX-License-Identifier: GPL-3.0-or-later
"""Refines a recording: adds poses where a model that was trained on it has its largest errors."""

from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..core.errors import RecordingError
from ..core.mathematics.features import joint_features
from ..core.mathematics.metrics import distances
from ..core.mathematics.partition import Partition
from ..core.mathematics.poses import Channel, sample_pose
from ..core.mathematics.refinement import Probes, choose_poses, nearest_recorded_distances
from ..core.progress import Progress
from ..core.recording.reader import Recording, read_recording
from ..core.recording.writer import RecordingExtension
from ..core.rig import rig_differences
from ..core.settings import REFINEMENT_POSES, SPREAD
from ..poses.sampling import model_channels
from ..rig.modifier_stack import check_evaluable
from ..rig.pose_setter import temporary_rig_state
from ..rig.reading import PoseEvaluator, read_rig
from ..rig.shape_keys import set_keys_undriven
from ..rig.time_inputs import check_time_inputs
from ..runtime.network import Network
from ..runtime.opened_model import open_model
from ..scene.armature import Poser
from ..scene.scene_rig import SceneRig, check_full_rig
from .run import PoseAppender

PROBE_INDEX, BASE_INDEX = 1 << 34, 1 << 35
"""First indices of random probe poses and base poses, larger than any pose index of a recording or an evaluation."""
MIN_PROBES = 200
"""Smallest number of random poses on which the model is evaluated."""
WIDE_SPREAD = 10.0
"""Spread of every second probe, which is almost uniform, because animations reach the ends of the range more often than
a recording."""


@dataclass(frozen=True)
class RefinementSettings:
    """Settings of a refinement.

    Attributes:
        poses: number of poses to add.
        seed: seed of the random choices, which also depend on the length of the recording.
    """

    poses: int = REFINEMENT_POSES
    seed: int = 0


def refine(scene_rig: SceneRig, path: Path, model: Path, settings: RefinementSettings) -> Iterator[Progress]:
    """Add poses to a complete recording while the generator is iterated.

    The scene is restored when the generator ends, is closed, or raises. The recording is complete at any time.

    Args:
        scene_rig: the rig that was recorded.
        path: folder of the recording.
        model: file of a model trained on the recording.
        settings: settings of the refinement.

    Yields:
        Progress of the stages "probes" and "poses".
    """
    recording, stacks = read_recording(path), []
    if recording.info.target:
        raise RecordingError(
            f"The recording '{path}' is of the target '{recording.info.target.object_name}', and poses are added of "
            "rigs alone; record more poses of the target into another folder."
        )
    for _, part in scene_rig.parts:
        check_full_rig(part.mesh_object)
        stacks.append(check_evaluable(part))
    opened = open_model(scene_rig, model)
    network, rig = opened.network, replace(opened.rig, joints=opened.network.info.joints)
    for mesh_object, stack in zip(scene_rig.mesh_objects, stacks, strict=True):
        check_time_inputs(scene_rig, rig.controls, stack, (), mesh_object)
    channels = model_channels(scene_rig, rig, network.info)
    _check_recording(scene_rig, recording, channels)
    recorded_count = len(recording.pose_matrices)
    with temporary_rig_state(scene_rig, rig, channels), set_keys_undriven(scene_rig, channels):
        evaluator, poser = PoseEvaluator(scene_rig, rig), Poser(scene_rig, channels)
        first_probe = PROBE_INDEX + recorded_count
        probe_poses = np.stack(
            [
                sample_pose(channels, settings.seed, index, WIDE_SPREAD if index % 2 else SPREAD.default)
                for index in range(first_probe, first_probe + max(MIN_PROBES, settings.poses))
            ]
        )
        partitions = network.info.partitions_of(opened.linear_rig)
        probe_matrices, errors = yield from _evaluate_probes(probe_poses, poser, evaluator, network, partitions)
        columns = [recording.rig.joint_names.index(name) for name in rig.joint_names]
        poses = np.delete(np.arange(recorded_count), recording.info.alone_poses)
        recorded_matrices = np.array(recording.pose_matrices[poses][:, columns])
        probe_features, recorded_features = (
            joint_features(matrices, rig.rest_matrices, rig.references)
            for matrices in (probe_matrices, recorded_matrices)
        )
        distances_to_recording = np.stack(
            [
                nearest_recorded_distances(
                    *(
                        features[:, list(partition.influencing)].reshape(len(features), -1)
                        for features in (probe_features, recorded_features)
                    )
                )
                for partition in partitions
            ],
            axis=1,
        )
        probes = Probes(probe_poses, errors, distances_to_recording)
        base_poses = np.stack(
            [sample_pose(channels, settings.seed, BASE_INDEX + recorded_count + i) for i in range(settings.poses)]
        )
        rng = np.random.default_rng([settings.seed, recorded_count])
        input_names = np.array([*rig.joint_names, *(control.name for control in rig.controls)])
        joint_count = len(rig.joints)
        inputs = [[*p.influencing, *(joint_count + control for control in p.controls)] for p in partitions]
        channel_names = [channel.name for channel in channels]
        influencing_channels = [np.flatnonzero(np.isin(channel_names, input_names[indices])) for indices in inputs]
        chosen_poses = choose_poses(probes, channels, influencing_channels, base_poses, rng)
        recorded_evaluator = PoseEvaluator(scene_rig, recording.rig)
        with (
            RecordingExtension(recording, settings.poses, model.name) as extension,
            PoseAppender(recorded_evaluator, extension, rig.vertex_count) as appender,
        ):
            for pose in chosen_poses:
                poser.set(pose)
                appender.append_current_pose()
                yield Progress("poses", appender.pose_count - recorded_count, settings.poses)


def _evaluate_probes(
    poses: np.ndarray,
    poser: Poser,
    evaluator: PoseEvaluator,
    network: Network,
    partitions: Sequence[Partition],
) -> Generator[Progress, None, tuple[np.ndarray, np.ndarray]]:
    """Evaluate M poses with the rig and with the model.

    Returns:
        Pose matrices, (M, J, 4, 4), mesh-object space, mesh units; the largest error of each partition, (M, P), mesh
        units.
    """
    pose_matrices, partition_errors = [], []
    for index, pose in enumerate(poses):
        poser.set(pose)
        matrices, rig_positions, controls = evaluator.evaluate()
        errors = distances(network.positions(matrices[None], controls[None])[0], rig_positions)
        pose_matrices.append(matrices)
        partition_errors.append([errors[partition.vertices].max() for partition in partitions])
        yield Progress("probes", index + 1, len(poses))
    return np.stack(pose_matrices), np.array(partition_errors)


def _check_recording(scene_rig: SceneRig, recording: Recording, channels: tuple[Channel, ...]) -> None:
    recorded_rig = recording.rig
    rig = read_rig(scene_rig, recorded_rig.joint_names, are_joints_complete=True)
    rig = replace(rig, controls=recorded_rig.controls)
    differences = rig_differences(recorded_rig.joints, recorded_rig.rest_matrices, recorded_rig.meshes, rig)
    if differences:
        raise RecordingError(
            f"'{recording.path}' is a recording of another rig: {'; '.join(differences)}. Record this rig."
        )
    if not recording.info.sampling.channels:
        raise RecordingError(
            f"'{recording.path}' has no random poses, so there is no range of motion to choose from; record with "
            "--poses."
        )
    if recording.info.sampling.channels != channels:
        raise RecordingError(
            f"The range of motion of the model is not that of '{recording.path}'; give the recording that it was "
            "trained on, or train a model on this one."
        )
