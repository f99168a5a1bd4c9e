# SPDX-License-Identifier: GPL-3.0-or-later
"""Turns poses of a rig into a recording."""

import contextlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np

from .core.errors import RecordingError, RigError
from .core.output import check_folder_writable
from .core.partition import INFLUENCE_TOLERANCE, make_partitions, residual_changes
from .core.poses import DEFAULT_SPREAD, Channel, sample_pose
from .core.progress import Progress
from .core.recording import RecordingInfo, Sampling, Source
from .core.recording_extension import RecordingExtension
from .core.recording_writer import RecordingWriter
from .core.rig import Rig
from .core.skinning import LinearLayer
from .scene.armature import Poser, clear_pose
from .scene.borrow import assign_action, borrowed_pose
from .scene.modifier_stack import borrowed_stack
from .scene.rig import PoseEvaluator, SceneRig, check_evaluable, read_rig, sampled_channels

BATCH_BYTES = 6 << 20
BATCH_POSES = 250
"""Poses go to the disk in batches of at most this size, so that an interruption loses little."""

INFLUENCE_SEED_OFFSET = 1 << 32
"""Poses of the influence detection are drawn from indices that no pose of a recording reaches."""


@dataclass(frozen=True)
class RecordingSettings:
    """What to record.

    Attributes:
        poses: number of random poses.
        seed: of the random poses.
        spread: standard deviation of the random poses as a part of half the range of motion.
        actions: names of actions whose frames are recorded after the random poses.
        influence_poses: how often each joint is moved alone to find the partitions that it influences.
        influence_tolerance: a joint influences a partition when it moves a local residual by more than this part of
            the character's size.
        resume: continue a recording that was interrupted.
    """

    poses: int = 1000
    seed: int = 0
    spread: float = DEFAULT_SPREAD
    actions: tuple[str, ...] = ()
    influence_poses: int = 10
    influence_tolerance: float = INFLUENCE_TOLERANCE
    resume: bool = False


def record(scene_rig: SceneRig, path: Path, settings: RecordingSettings) -> Iterator[Progress]:
    """Record a rig; a generator that does the work while it is iterated.

    The scene is as before when the generator ends, is closed, or raises.

    Args:
        scene_rig: the rig.
        path: folder of the recording.
        settings: what to record.

    Yields:
        Progress of the stages "influences" and "poses".

    Raises:
        RigError: the rig cannot be recorded.
        RecordingError: there is a recording already, or the one to resume is of something else.
        OutputError: the folder cannot be written.
    """
    actions = [find_action(name) for name in settings.actions]
    check_evaluable(scene_rig)
    rig = read_rig(scene_rig)
    channels = sampled_channels(scene_rig, rig) if settings.poses else ()
    check_folder_writable(path)
    sampling = planned_sampling(settings, channels)
    total = sum(source.poses for source in sampling.sources)
    if total < 1:
        raise RecordingError("There is nothing to record: 0 poses and no action; give --poses or --action.")
    info = RecordingInfo(
        total, 0, Path(bpy.data.filepath).name, scene_rig.mesh_object.name, bpy.app.version_string, sampling
    )

    with borrowed_stack(scene_rig.mesh_object), borrowed_pose(scene_rig.armature_object, actions):
        clear_pose(scene_rig.armature_object)
        evaluator = PoseEvaluator(scene_rig, rig)
        partitions = yield from _detect_influences(scene_rig, rig, channels, evaluator, settings)
        layer = LinearLayer(rig, partitions)
        with RecordingWriter(path, rig, partitions, info, settings.resume) as writer:
            poses = _poses(scene_rig, channels, settings, actions, writer.complete)
            yield Progress("poses", writer.complete, total)
            # Closed before the writer: what was evaluated is kept when the recording is broken off.
            with contextlib.closing(append_poses(poses, evaluator, layer, writer)) as steps:
                for done in steps:
                    yield Progress("poses", done, total)


def planned_sampling(settings: RecordingSettings, channels: tuple[Channel, ...]) -> Sampling:
    """How the poses of a recording with these settings are chosen.

    Raises:
        RigError: there is no action of a name that the settings have.
    """
    sources = [Source("random", settings.poses)] if settings.poses else []
    sources += [_action_source(find_action(name)) for name in settings.actions]
    return Sampling(settings.seed, settings.spread, channels if settings.poses else (), tuple(sources))


def find_action(name: str) -> bpy.types.Action:
    """An action of the file by its name.

    Raises:
        RigError: there is none of this name.
    """
    action = bpy.data.actions.get(name)
    if action is None:
        known = ", ".join(f"'{a.name}'" for a in bpy.data.actions) or "none"
        raise RigError(f"The file has no action '{name}'; its actions: {known}.")
    return action


def action_frames(action: bpy.types.Action) -> range:
    """The whole frames of an action."""
    first, last = (round(frame) for frame in action.frame_range)
    return range(first, last + 1)


def _action_source(action: bpy.types.Action) -> Source:
    frames = action_frames(action)
    return Source("action", len(frames), action.name, (frames.start, 1))


def _poses(
    scene_rig: SceneRig,
    channels: tuple[Channel, ...],
    settings: RecordingSettings,
    actions: list[bpy.types.Action],
    first: int,
) -> Iterator[None]:
    """Pose the rig, one pose an iteration, from pose `first` of the recording on."""
    poser = Poser(scene_rig.armature_object, channels)
    for index in range(first, settings.poses):
        poser.set(sample_pose(channels, settings.seed, index, settings.spread))
        yield
    start = settings.poses
    for action in actions:
        clear_pose(scene_rig.armature_object)
        assign_action(scene_rig.armature_object, action)
        for index, frame in enumerate(action_frames(action), start):
            if index >= first:
                bpy.context.scene.frame_set(frame)
                yield
        start += len(action_frames(action))


def append_poses(
    poses: Iterator[None],
    evaluator: PoseEvaluator,
    layer: LinearLayer,
    writer: RecordingWriter | RecordingExtension,
) -> Iterator[int]:
    """Evaluate poses and append them to the recording in batches, one pose an iteration; how many it has is yielded.

    When it is closed, the poses that were evaluated are appended.
    """
    size = max(1, min(BATCH_POSES, BATCH_BYTES // (layer.rig.vertex_count * 12)))
    done = writer.complete
    with ThreadPoolExecutor(max_workers=1) as appending:
        # While a batch is turned into residuals and written, Blender evaluates the next one.
        previous: Future | None = None
        matrices, positions = [], []
        try:
            for _ in poses:
                pose, evaluated = evaluator.evaluate()
                matrices.append(pose)
                positions.append(evaluated)
                done += 1
                if len(matrices) == size:
                    if previous is not None:
                        previous.result()
                    previous = appending.submit(_append, writer, layer, matrices, positions)
                    matrices, positions = [], []
                yield done
        except GeneratorExit:
            _append_last(previous, writer, layer, matrices, positions)
            raise
        _append_last(previous, writer, layer, matrices, positions)


def _append_last(
    previous: Future | None,
    writer: RecordingWriter | RecordingExtension,
    layer: LinearLayer,
    matrices: list,
    positions: list,
) -> None:
    if previous is not None:
        previous.result()
    if matrices:
        _append(writer, layer, matrices, positions)


def _append(writer: RecordingWriter | RecordingExtension, layer: LinearLayer, matrices: list, positions: list) -> None:
    pose_matrices = np.stack(matrices)
    writer.append(pose_matrices, _local_residuals(layer, pose_matrices, np.stack(positions)))


def _local_residuals(layer: LinearLayer, pose_matrices: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """As `LinearLayer.local_residuals`, with a sentence for a joint without extent."""
    try:
        return layer.local_residuals(pose_matrices, positions)
    except np.linalg.LinAlgError as error:
        flat = np.abs(np.linalg.det(pose_matrices[:, :, :3, :3].astype(np.float64))).min(axis=0)
        raise RigError(
            f"Bone '{layer.rig.joint_names[int(flat.argmin())]}' has a scale of zero in some pose; "
            "look for a constraint or driver that sets it."
        ) from error


def _detect_influences(
    scene_rig: SceneRig,
    rig: Rig,
    channels: tuple[Channel, ...],
    evaluator: PoseEvaluator,
    settings: RecordingSettings,
) -> Iterator[Progress]:
    """Move one joint at a time, from the rest pose and from random ones; returns the partitions.

    A joint that a constraint moves is left out: it follows from the joint that moves it. When no joint may be moved
    (an action alone is recorded), nothing is known and every joint influences every partition.
    """
    partitions = make_partitions(rig)
    if not channels:
        return make_partitions(rig, {partition.joint: tuple(range(len(rig.joints))) for partition in partitions})
    layer = LinearLayer(rig, partitions)
    poser = Poser(scene_rig.armature_object, channels)
    threshold = settings.influence_tolerance * rig.size
    places = {
        joint: [i for i, c in enumerate(channels) if c.bone == name] for joint, name in enumerate(rig.joint_names)
    }
    moved = {joint: own for joint, own in places.items() if own}
    rest = np.array([min(max(0.0, c.low), c.high) for c in channels])
    count = settings.influence_poses
    influencing: dict[int, set[int]] = {partition.joint: set() for partition in partitions}

    def local_residuals(values: np.ndarray) -> np.ndarray:
        poser.set(values)
        pose, positions = evaluator.evaluate()
        return _local_residuals(layer, pose[None], positions[None])

    def draw(index: int) -> np.ndarray:
        return sample_pose(channels, settings.seed, INFLUENCE_SEED_OFFSET + index, settings.spread)

    total = count * (len(moved) + 1)
    # One base pose serves all joints: the rest pose for half of the moves, a random pose each for the others.
    bases = [rest] * (count - count // 2) + [draw(number) for number in range(count // 2)]
    for number, base in enumerate(bases):
        base_residuals = local_residuals(base)
        for step, (joint, own) in enumerate(moved.items(), number * (len(moved) + 1) + 1):
            yield Progress("influences", step, total)
            values = base.copy()
            values[own] = draw((joint + 1) * count + number)[own]
            changes = residual_changes(partitions, local_residuals(values), base_residuals)
            for partition, change in zip(partitions, changes, strict=True):
                if change > threshold:
                    influencing[partition.joint].add(joint)
        yield Progress("influences", (number + 1) * (len(moved) + 1), total)
    return make_partitions(rig, {joint: tuple(sorted(found)) for joint, found in influencing.items()})
