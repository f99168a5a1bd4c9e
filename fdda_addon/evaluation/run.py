# SPDX-License-Identifier: GPL-3.0-or-later
"""Compares a model and linear skinning with the rig, on poses that were not used in training."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ..core.checks.target import is_frozen
from ..core.errors import FDDAError, RigError
from ..core.mathematics.mask import Mask
from ..core.mathematics.metrics import distances
from ..core.mathematics.poses import Channel, sample_pose, widen_ranges
from ..core.mathematics.skinning import LinearSkinning
from ..core.mathematics.surface import Surface, SurfaceComparison, surface_errors
from ..core.progress import Job, Progress
from ..poses.clip import find_clips
from ..poses.sampling import model_channels
from ..rig.modifier_stack import check_evaluable
from ..rig.pose_setter import (
    DIRECT_POSE_SETTER,
    PoseSetter,
    blend_from_rest,
    make_pose_setter,
    temporary_rig_state,
)
from ..rig.reading import PoseEvaluator
from ..rig.shape_keys import set_keys_undriven
from ..rig.time_inputs import check_time_inputs
from ..runtime.model_meshes import find_mesh
from ..runtime.network import Network
from ..runtime.opened_model import open_model
from ..scene.armature import Poser, clear_pose
from ..scene.mask import read_mask
from ..scene.scene_rig import SceneRig, check_full_rig
from .results import Evaluation, PoseErrors
from .settings import EvaluationSettings

FIRST_HELD_OUT_INDEX = 1 << 33
"""Index of the first held-out random pose. It is larger than the number of poses of any recording, so the held-out
poses differ from all recorded poses, even with the same seed."""


def evaluate(scene_rig: SceneRig, model: Path | Network, settings: EvaluationSettings) -> Job[Evaluation]:
    """Compare a model with the rig of one mesh; arguments and errors as of `evaluate_meshes`."""
    return (yield from evaluate_meshes([scene_rig], model, settings))[0]


def evaluate_meshes(
    rigs: Sequence[SceneRig], model: Path | Network, settings: EvaluationSettings
) -> Job[list[Evaluation]]:
    """Compare a model with the rigs of its meshes while the generator is iterated; each pose is evaluated once.

    If a mesh object has a mask, the mask is applied to the model. The scene is restored when the generator ends, is
    closed, or raises.

    Args:
        rigs: the rigs of meshes of the model, on one armature.
        model: path of the model, or the loaded model.

    Returns:
        The errors of each mesh, in the order of the rigs.

    Raises:
        RigError: the rig cannot be evaluated.
        ModelError: the model cannot be read, or was trained for another rig.
    """
    scene_rig, *other_rigs = rigs
    clips = find_clips([scene_rig], settings.actions, settings.strips)
    if not settings.poses and not clips:
        raise RigError("There is nothing to evaluate: 0 poses and no action; give --poses or --action.")
    random_pose_count = settings.poses or len(settings.range_scales)
    network = model if isinstance(model, Network) else Network(model)
    opened_models, skinnings = [], []
    for rig in rigs:
        check_full_rig(rig.mesh_object)
        modifier_stack = check_evaluable(rig)
        opened_models.append(open_model(rig, network.model))
        if not settings.target.name:
            check_time_inputs(rig, opened_models[-1].linear_rig.controls, modifier_stack)
        linear_rig = opened_models[-1].linear_rig
        skinnings.append(LinearSkinning(linear_rig, opened_models[-1].network.info.partitions_of(linear_rig)))
    info, skinning = opened_models[0].network.info, skinnings[0]
    pose_setter = make_pose_setter(scene_rig, settings.target, clips, random_pose_count, info.controls)
    # A rig that is posed only by actions may have no channels to sample.
    channels = model_channels(scene_rig, skinning.rig, info) if settings.poses or settings.range_scales else ()
    # Channels name the shape keys of other meshes by the names of the meshes in the model.
    other_objects = (rig.mesh_object for rig in other_rigs)
    other_meshes = ((find_mesh(network.path, network.model.info, other), other) for other in other_objects)
    character = replace(scene_rig, other_meshes=tuple(other_meshes))
    random_poses = partial(_random_poses, character, pose_setter, settings.seed)
    with ExitStack() as stack:
        if pose_setter.target:
            stack.enter_context(pose_setter.target.prepared())
        player = stack.enter_context(temporary_rig_state(character, skinning.rig, channels, clips))
        parts = [
            _MeshComparison(
                PoseEvaluator(rig, part_skinning.rig, pose_setter.target),
                opened.network,
                part_skinning,
                settings.surface,
                read_mask(rig.mesh_object),
            )
            for rig, opened, part_skinning in zip(rigs, opened_models, skinnings, strict=True)
        ]
        comparison = _Comparison(parts, settings.total_poses(clips))
        held_out: list[PoseErrors] = []
        if settings.poses:
            poses = random_poses(channels, FIRST_HELD_OUT_INDEX, settings.poses)
            held_out = yield from comparison.compare("held-out poses", poses)
        scaled_range_errors, action_errors = [], []
        for scale_index, factor in enumerate(settings.range_scales, 1):
            wide_channels, first_index = widen_ranges(channels, factor), FIRST_HELD_OUT_INDEX * (1 + scale_index)
            poses = random_poses(wide_channels, first_index, settings.scaled_poses)
            scaled_range_errors.append((yield from comparison.compare(f"{factor:g} times the range", poses)))
        for clip in clips:
            poses = pose_setter.show_frames(player, clip, range(len(clip.frames)))
            action_errors.append((yield from comparison.compare(clip.title, poses)))
    return [
        Evaluation(
            part_skinning.partitions,
            part_skinning.rig.joint_names,
            (held_out or action_errors[0])[index],
            [errors[index] for errors in action_errors],
            [errors[index] for errors in scaled_range_errors],
            # A channel of a shape key is named as seen from its mesh.
            (opened.network.info.limits or channels) if channels else (),
        )
        for index, (opened, part_skinning) in enumerate(zip(opened_models, skinnings, strict=True))
    ]


def evaluate_action(scene_rig: SceneRig, model: Path | Network, name: str) -> Job[Evaluation]:
    """Compare only the positions, and only on the frames of one action, which become `Evaluation.held_out`."""
    evaluation = yield from evaluate(scene_rig, model, EvaluationSettings(poses=0, actions=(name,), surface=False))
    evaluation.actions = []
    return evaluation


def set_held_out_pose(scene_rig: SceneRig, channels: tuple[Channel, ...], seed: int, index: int) -> None:
    """Set one of the random poses of an evaluation.

    Args:
        channels: the channels of the evaluation.
        seed: the seed of the evaluation.
        index: index of the pose in the evaluation.
    """
    clear_pose(scene_rig.armature_object)
    next(_random_poses(scene_rig, DIRECT_POSE_SETTER, seed, channels, FIRST_HELD_OUT_INDEX + index, 1))


def _random_poses(
    scene_rig: SceneRig,
    pose_setter: PoseSetter,
    seed: int,
    channels: tuple[Channel, ...],
    first_index: int,
    count: int,
) -> Iterator[None]:
    poser = Poser(scene_rig, channels)
    with pose_setter.prepared(), set_keys_undriven(scene_rig, channels):
        for index in range(first_index, first_index + count):
            values = sample_pose(channels, seed, index)
            pose_setter.set_pose(blend_from_rest(poser.set, channels, values))
            yield


class _MeshComparison:
    """Compares rig, model and linear skinning of one mesh in a set of poses."""

    def __init__(
        self, evaluator: PoseEvaluator, network: Network, skinning: LinearSkinning, surface: bool, mask: Mask | None
    ):
        self._mask = mask
        self._evaluator, self._network, self._skinning = evaluator, network, skinning
        rig, self._surface = skinning.rig, None
        self._metres_per_unit = rig.metres_per_unit
        if surface and len(rig.face_starts):
            faces = Surface(rig.face_starts, rig.face_vertices)
            self._surface = SurfaceComparison(faces, rig.rest_positions, skinning.partitions)
        self._poses: list[tuple[np.ndarray, ...]] = []
        self._surfaces: list[tuple] = []
        self._previous_linear_positions, self._frozen_count = np.empty(0), 0

    def add_pose(self, name: str) -> None:
        """Compare the current pose of the scene, of a set of poses with a name."""
        pose_matrices, rig_positions, controls = self._evaluator.evaluate()
        model_positions = self._network.positions(pose_matrices[None], controls[None])[0]
        for positions, subject in ((rig_positions, "The rig"), (model_positions, f"The model '{self._network.path}'")):
            if not np.isfinite(positions).all():
                raise FDDAError(
                    f"{subject} gives positions that are not numbers ({name}, pose {len(self._poses)}); "
                    "look for a scale of zero or a broken driver in the rig, else train again."
                )
        linear_positions = self._skinning.positions(pose_matrices[None])[0]
        if self._evaluator.target and self._poses:
            positions = (rig_positions, self._poses[-1][1]), (linear_positions, self._previous_linear_positions)
            motions = (distances(*pair).max() for pair in positions)
            self._frozen_count += bool(is_frozen(*motions, self._skinning.rig.size))
        self._previous_linear_positions = linear_positions
        if self._mask is not None:
            model_positions = self._mask.blend(linear_positions, model_positions)
        errors = (distances(p, rig_positions, self._metres_per_unit) for p in (model_positions, linear_positions))
        self._poses.append((pose_matrices, rig_positions, controls, *errors))
        if self._surface:
            self._surfaces.append(self._surface.compare(rig_positions, (model_positions, linear_positions)))

    def end_set(self, name: str) -> PoseErrors:
        """Return the errors of the compared poses, and begin another set."""
        arrays = (np.stack(values) for values in zip(*self._poses, strict=True))
        surfaces = (surface_errors(rows) for rows in zip(*self._surfaces, strict=True))
        errors = PoseErrors(name, *arrays, *surfaces, frozen=self._frozen_count)
        self._poses, self._surfaces, self._frozen_count = [], [], 0
        return errors


class _Comparison:
    """Compares meshes in sets of poses, and counts the poses to report progress."""

    def __init__(self, parts: list[_MeshComparison], total: int):
        self._parts, self._compared_count, self._total_count = parts, 0, total

    def compare(self, name: str, poses: Iterator[None]) -> Job[list[PoseErrors]]:
        """Compare rig, model and linear skinning in a set of poses.

        Args:
            name: name of the set.
            poses: iterator that sets the next pose in each iteration.
        """
        for _ in poses:
            for part in self._parts:
                part.add_pose(name)
            self._compared_count += 1
            yield Progress("evaluation", self._compared_count, self._total_count)
        return [part.end_set(name) for part in self._parts]
