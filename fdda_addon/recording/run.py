# SPDX-License-Identifier: GPL-3.0-or-later
"""Records meshes of one armature in one session, which has the settings, the poses and the meshes."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, nullcontext
from dataclasses import replace
from pathlib import Path

import bpy

from ..core.errors import RecordingError
from ..core.mathematics.key_joints import add_influences
from ..core.mathematics.partition import GOLDEN_RATIO, Partition, assume_nearby_influences, make_merged_partitions
from ..core.mathematics.skinning import LinearSkinning
from ..core.progress import Progress
from ..core.recording.estimate import Estimate, check_disk_space, recording_bytes
from ..core.recording.folder_check import check_recordable
from ..core.recording.index import INDEX_NAME, RecordingInfo
from ..core.recording.target import POSE
from ..core.recording.writer import RecordingWriter
from ..poses.clip import find_clips
from ..poses.clip_player import ClipPlayer
from ..rig.modifier_stack import check_evaluable
from ..rig.target_poses import make_pose_setter
from ..rig.temporary_rig_state import temporary_rig_states
from ..rig.time_inputs import check_time_inputs
from ..scene.scene_rig import SceneRig, check_full_rig
from .appender import PoseAppender, append_poses
from .influence_trials import InfluenceSearch
from .influences import detect_influences
from .mesh_group import check_common_armature, group_into_passes, split_controls
from .plan import RecordingSettings, find_actions, make_pose_sampler, make_sampling, read_sampled_rig
from .pose_plan import PosePlan
from .previous_recording import read_previous_partitions, read_previous_weights
from .recorded_mesh import RecordedMesh, TimedEvaluator
from .reference_joints import find_references
from .repeatability import measure_repeatability
from .saturation_check import check_saturation
from .seam_check import check_seams
from .target_check import check_target_moves
from .time_check import check_follows_pose
from .weight_fitting import FittedWeights, check_has_weights, fit_weights, make_fit_request

INFLUENCE_SEED_OFFSET = 1 << 32
"""Offset of the indices of random poses for the detection of influences, larger than any pose index of a recording."""
MeshPhase = Callable[[RecordedMesh, ClipPlayer | None], Iterator[Progress]]


def record(scene_rig: SceneRig, path: Path, settings: RecordingSettings) -> Iterator[Progress]:
    """Record a rig while the generator is iterated.

    The scene is restored when the generator ends, is closed, or raises.

    Args:
        scene_rig: the rig.
        path: folder of the recording.
        settings: settings of the recording.

    Yields:
        Progress of the stages "influences" and "poses". If weights are fitted, the stages "poses to fit", "key joints"
        if these are chosen, and "fit" come first. The first progress of "poses" has a note with the estimated time and
        disk space.

    Raises:
        RigError: the rig cannot be recorded.
        TrainingError: the trainer's Python cannot fit the weights.
        RecordingError: the folder has a recording already, or the recording to resume differs.
        OutputError: the folder cannot be written, or the disk has too little space.
    """
    return record_meshes([(scene_rig, path)], settings)


def record_meshes(rigs: Sequence[tuple[SceneRig, Path]], settings: RecordingSettings) -> Iterator[Progress]:
    """Record several meshes on one armature, each into its own folder, as `record` does.

    The meshes share the poses, and each pose is evaluated once for all meshes of a pass (`group_into_passes`).

    Raises:
        RigError: as `record`, or the meshes follow different armatures.
    """
    yield from RecordingSession(rigs, settings).record()


class RecordingSession:
    """Records meshes on one armature, each into its own folder, in phases: the methods in their order.

    `record` runs all phases. A phase is a generator that yields its progress, and stores its results in the meshes.

    Attributes:
        settings: settings of the recording.
        clips: the clips whose frames follow the random poses.
        meshes: the meshes.
        poses: the poses, which the meshes share, and the target whose surface they have.
    """

    def __init__(self, rigs: Sequence[tuple[SceneRig, Path]], settings: RecordingSettings):
        """Plan the recordings of meshes and their poses, and raise all errors that can be found in advance."""
        scene_rigs, self.settings = [scene_rig for scene_rig, _ in rigs], settings
        check_common_armature(scene_rigs)
        self.clips = find_clips(scene_rigs, settings.actions, settings.strips, settings.mirror)
        if settings.mirror and not self.clips:
            raise RecordingError("There is nothing to mirror: no action and no strip; give --action or --strip.")
        controls = [settings.controls] if len(rigs) == 1 else split_controls(scene_rigs, settings)
        if settings.target.name and len(rigs) > 1:
            raise RecordingError("A target belongs to one mesh; record the meshes one by one, each with its target.")
        sampled_rigs, notes = [], []
        for (scene_rig, path), mesh_controls in zip(rigs, controls, strict=True):
            check_full_rig(scene_rig.mesh_object)
            stack = check_evaluable(scene_rig)
            sampled_rigs.append(read_sampled_rig(scene_rig, replace(settings, controls=mesh_controls)))
            notes.append("")
            if not settings.target.name:
                notes[-1] = check_time_inputs(scene_rig, sampled_rigs[-1][0].controls, stack, find_actions(settings))
            check_recordable(path, settings.resume, settings.overwrite)
        target_controls = sampled_rigs[0][0].controls
        pose_setter = make_pose_setter(scene_rigs[0], settings.target, self.clips, settings.poses, target_controls)
        channels = [mesh_channels for _, mesh_channels in sampled_rigs]
        self.poses = PosePlan(list(zip(scene_rigs, channels, strict=True)), settings, self.clips, pose_setter)
        if self.poses.total < 1:
            raise RecordingError("There is nothing to record: 0 poses and no action; give --poses or --action.")
        self.meshes = [
            RecordedMesh(
                *(scene_rig, rig, path, mesh_channels, self.poses.channels_of_mesh(index)),
                *(path if settings.resume and (path / INDEX_NAME).exists() else None, pose_setter.target, notes[index]),
            )
            for index, ((scene_rig, path), (rig, mesh_channels)) in enumerate(zip(rigs, sampled_rigs, strict=True))
        ]
        check_disk_space([(mesh.path, recording_bytes(mesh.rig, self.poses.total)) for mesh in self.meshes])

    def record(self) -> Iterator[Progress]:
        """Run all phases; the meshes of a pass are evaluated together (`group_into_passes`)."""
        target = self.poses.pose_setter.target
        with target.prepared() if target else nullcontext():
            posed_rigs = [mesh.posed_rig for mesh in self.meshes]
            with (
                temporary_rig_states(posed_rigs, self.clips) if self.settings.fits_weights else nullcontext() as player
            ):
                yield from self._for_each(self.meshes, self.fit_weights, player)
            for mesh_indices in group_into_passes([mesh.scene_rig for mesh in self.meshes]):
                meshes = [self.meshes[index] for index in mesh_indices]
                other_rigs = [mesh.posed_rig for mesh in self.meshes if mesh not in meshes]
                with temporary_rig_states([mesh.posed_rig for mesh in meshes], self.clips, other_rigs) as player:
                    if target:
                        yield from check_target_moves(meshes[0], self.poses, player)
                    check_follows_pose(meshes, self.poses, player)
                    yield from self._for_each(meshes, self.find_influences, player)
                    yield from self.record_poses(meshes, player)

    @staticmethod
    def _for_each(meshes: list[RecordedMesh], phase: MeshPhase, player: ClipPlayer | None) -> Iterator[Progress]:
        """Run a phase for each mesh. The stages of several meshes include the mesh's name."""
        for mesh in meshes:
            with closing(phase(mesh, player)) as steps:
                for step in steps:
                    yield step if len(meshes) == 1 else replace(step, stage=f"{step.stage} of '{mesh.name}'")

    def fit_weights(self, mesh: RecordedMesh, player: ClipPlayer | None) -> Iterator[Progress]:
        """Fit the skin weights of a mesh, read previously fitted weights, or keep the weights of the rig."""
        if mesh.previous_path:
            weights = read_previous_weights(mesh.previous_path, mesh.scene_rig, mesh.rig, self.settings)
        elif self.settings.fits_weights:
            request = make_fit_request(mesh.scene_rig, mesh.rig, self.settings, mesh.channels, self.poses.total)
            shown_poses = self.poses.show_poses(player, frozenset(request.poses))
            # After an error, its traceback keeps the generator, which would restore limits only later.
            with closing(shown_poses):
                weights = yield from fit_weights(mesh.scene_rig, mesh.rig, request, shown_poses, mesh.make_evaluator())
        else:
            check_has_weights(mesh.scene_rig, mesh.rig)
            weights = FittedWeights(mesh.rig, None)
        mesh.rig, mesh.fit, mesh.needed_inputs = weights.rig, weights.fit, weights.needed_inputs

    def find_influences(self, mesh: RecordedMesh, player: ClipPlayer) -> Iterator[Progress]:
        """Read the reference joints and influences of a previous recording, or find them with this mesh's channels."""
        mesh.evaluator = TimedEvaluator(mesh.make_evaluator())
        min_vertices = self.settings.min_partition_vertices
        if mesh.previous_path:
            mesh.rig, mesh.partitions = read_previous_partitions(mesh.previous_path, mesh.rig, min_vertices)
        if mesh.partitions:
            return
        for note in filter(None, (mesh.note, check_seams(mesh, self.poses, player), check_saturation(mesh))):
            yield Progress("influences", 0, 1, note)
        mesh.rig = find_references(mesh, self.poses, player)
        partitions = make_merged_partitions(mesh.rig, min_vertices)
        if mesh.target and mesh.target.follows != POSE:
            # A target that depends on time does not follow a moved joint immediately: influences cannot be detected.
            partitions = assume_nearby_influences(mesh.rig, partitions)
        else:
            partitions = yield from self._detect_influences(mesh, partitions, player)
        if mesh.needed_inputs is not None:
            partitions = add_influences(partitions, mesh.needed_inputs, len(mesh.rig.joints))
        mesh.partitions = partitions

    def _detect_influences(
        self, mesh: RecordedMesh, partitions: tuple[Partition, ...], player: ClipPlayer
    ) -> Iterator[Progress]:
        sampler = make_pose_sampler(mesh.scene_rig, self.settings)
        frames = [(clip, frame) for clip in self.clips for frame in clip.frames]
        search = InfluenceSearch(
            mesh.channels,
            lambda index: sampler.draw_pose(mesh.channels, INFLUENCE_SEED_OFFSET + index),
            # Consecutive indices result in frames that are far apart.
            lambda index: player.show(*frames[int(index * GOLDEN_RATIO * len(frames)) % len(frames)]),
            player.stop,
            self.settings.influence_poses,
            self.settings.influence_tolerance,
            mesh.target is not None,
            mesh.target is not None or mesh.needed_inputs is not None,
        )
        return (yield from detect_influences(mesh.scene_rig, mesh.rig, partitions, mesh.evaluator, search))

    def record_poses(self, meshes: list[RecordedMesh], player: ClipPlayer) -> Iterator[Progress]:
        """Evaluate the poses that are missing, and write them; then measure the repeatability of a target."""
        pose_setter, pose_count = self.poses.pose_setter, self.poses.total
        with ExitStack() as stack:
            appenders = []
            for mesh in meshes:
                info = self._make_info(mesh)
                options = self.settings.resume, self.settings.overwrite
                writer = stack.enter_context(RecordingWriter(mesh.path, mesh.rig, mesh.partitions, info, *options))
                skinning = LinearSkinning(mesh.rig, mesh.partitions)
                appenders.append(PoseAppender(mesh.evaluator, skinning, writer, pose_setter))
                if writer.note:
                    yield Progress("poses", 0, pose_count, writer.note)
            done = min(appender.pose_count for appender in appenders)
            yield Progress("poses", done, pose_count, self._describe_estimate(meshes, pose_count - done))
            remaining_poses = self.poses.show_poses(player, range(done, pose_count))
            # Close the generators before the writers, so that an interrupted recording keeps the evaluated poses.
            with closing(remaining_poses), closing(append_poses(remaining_poses, appenders)) as pose_counts:
                for done in pose_counts:
                    yield Progress("poses", done, pose_count, detail=pose_setter.rest_description)
            repeated_count = self.settings.target.repeatability_poses
            if self.poses.repeatable_poses and repeated_count:
                yield from measure_repeatability(meshes[0], self.poses, player, writer, repeated_count)
                yield Progress("poses", pose_count, pose_count)

    def _describe_estimate(self, meshes: list[RecordedMesh], remaining_count: int) -> str:
        """Describe the remaining work of meshes that are evaluated together; empty if no poses remain."""
        if not remaining_count:
            return ""
        settle_seconds = self.poses.pose_setter.seconds_per_pose
        # The whole scene is evaluated for each pose, so the times of meshes do not add up.
        seconds = [settle_seconds or mesh.evaluator.seconds_per_pose for mesh in meshes]
        remaining_seconds = None if None in seconds else max(seconds) * remaining_count
        vertex_count = sum(mesh.rig.vertex_count for mesh in meshes)
        total_bytes = sum(recording_bytes(mesh.rig, self.poses.total) for mesh in meshes)
        return Estimate(remaining_count, vertex_count, total_bytes, remaining_seconds).sentence()

    def _make_info(self, mesh: RecordedMesh) -> RecordingInfo:
        """Make the info of the recording of a mesh."""
        sampling = make_sampling(mesh.scene_rig, self.settings, mesh.limits)
        file_name, blender_version = Path(bpy.data.filepath).name, bpy.app.version_string
        origin = file_name, mesh.name, blender_version, sampling, mesh.fit
        return RecordingInfo(self.poses.total, 0, *origin, self.poses.pose_setter.recorded_target)
