# SPDX-License-Identifier: GPL-3.0-or-later
"""What the networks are trained on: features and coefficients of each partition."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.features import float32_rounding
from fdda_addon.core.partition import Partition
from fdda_addon.core.recording.index import RANDOM, REFINED, Source
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.rig import Fingerprint
from fdda_addon.core.skinning import skin_matrices

from .basis import FINER, Basis, make_basis, share_shapes
from .config import TrainingConfig
from .inputs import Inputs
from .joint_fit import JointFit, Surroundings, surroundings_of_rig
from .patterns import find_patterns, may_have_patterns
from .turns import fit_matrices

MIN_POSES = 10
BLOCK_FRAMES = 10
"""Frames of animation that are held back together: neighbors are nearly the same pose."""
MARGIN_WEIGHT = 0.1
"""What a pose of the margin counts for in the basis, where others count 1: its residual is many times as large, and the
shapes are chosen for the range of motion."""
MIN_SPREAD = 1e-5
"""A feature that spreads less than this over the training poses counts as constant: mesh units, or no unit."""
BLOCK_FLOATS = 1 << 22
"""Residuals are measured in blocks of so many coordinates: all of a partition, in float64, are twice as large."""


@dataclass(frozen=True)
class PartitionData:
    """Features and residuals of one partition, from a recording or from elsewhere.

    Attributes:
        name: of the main joint.
        features: (N, F) float32, what the network sees of each pose; F may be 0.
        read_residuals: gives the (N, Vp, 3) float32 local residuals, mesh units; called once, so that not all
            partitions need to be in memory at a time.
        vertices: Vp.
        read_surroundings: gives what the residuals are fitted to first; called twice at most. None when nothing is
            known of the joints.
        least_spread: (F,) float64, what a feature spreads at least that counts as varying, or one for all.
    """

    name: str
    features: np.ndarray
    read_residuals: Callable[[], np.ndarray]
    vertices: int
    read_surroundings: Callable[[], Surroundings] | None = None
    least_spread: np.ndarray | float = MIN_SPREAD


@dataclass(frozen=True)
class Split:
    """Indices of poses, ascending.

    Attributes:
        training: those that the basis and the weights are made of.
        validation: those that choose the best weights.
        held_out: those that nothing is made of or chosen by, to measure the error on.
        margin: those of `training` that lie around the range of motion.
    """

    training: np.ndarray
    validation: np.ndarray
    held_out: np.ndarray
    margin: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def weights(self, of_margin: float) -> np.ndarray:
        """(n,) float64 of the training poses: 1, or `of_margin` for those of the margin."""
        return np.where(np.isin(self.training, self.margin), of_margin, 1.0)


@dataclass(frozen=True)
class PreparedPartition:
    """A partition, ready to train.

    Attributes:
        name: of the main joint.
        vertices: Vp.
        columns: (F',) int32, the features that vary over the training poses and that the network sees.
        feature_mean, feature_scale: (F',) float32, mean and standard deviation over the training poses.
        inputs: (N, F') float32, standardized features of all poses.
        fit: the part of the residuals that follows from the joints around.
        basis: of what the fit leaves of the residuals of the training poses.
        coefficients: (N, K) float32, of all poses, mesh units.
        residual_rms: rms distance over training poses and vertices that the fit leaves, about the mean, mesh units.
        validation_truncation: (n,) rms distance over the vertices that the basis leaves of each validation pose,
            mesh units.
        validation: (n,) indices of these poses.
        mm_per_unit: what lengths above have to be multiplied by to be in mm, as in `Rig.metres_per_unit`.
        patterns: (r, Vp) float32, of which fit and basis are made (`patterns`); None where they are of any numbers.
    """

    name: str
    vertices: int
    columns: np.ndarray
    feature_mean: np.ndarray
    feature_scale: np.ndarray
    inputs: np.ndarray
    fit: JointFit
    basis: Basis
    coefficients: np.ndarray
    residual_rms: float
    validation_truncation: np.ndarray
    validation: np.ndarray
    mm_per_unit: float = 1000.0
    patterns: np.ndarray | None = None

    def with_shapes(self, count: int) -> "PreparedPartition":
        """The same with the first `count` shapes alone."""
        left_out = self.coefficients[self.validation, count:].astype(np.float64)
        squared = self.validation_truncation**2 + (left_out**2).sum(axis=1) / self.vertices
        return replace(
            self,
            basis=self.basis.first(count),
            coefficients=np.ascontiguousarray(self.coefficients[:, :count]),
            validation_truncation=np.sqrt(squared),
        )


def split_poses(poses: np.ndarray, validation_fraction: float, seed: int, held_out_fraction: float = 0.0) -> Split:
    """Choose the poses that do not train at random.

    Args:
        poses: (n,) indices of the poses that may be used.
        validation_fraction, held_out_fraction, seed: as in `TrainingConfig`; a fraction of 0 holds nothing out.

    Raises:
        TrainingError: there are too few poses.
    """
    _check_count(len(poses))
    return _split(poses, validation_fraction, seed, held_out_fraction)


def _check_count(count: int) -> None:
    if count < MIN_POSES:
        raise TrainingError(f"The recording has {count} poses and training takes at least {MIN_POSES}; record more.")


def _split(items: np.ndarray, validation_fraction: float, seed: int, held_out_fraction: float) -> Split:
    order = np.random.default_rng([seed, 1]).permutation(items)
    validation = max(1, round(len(items) * validation_fraction))
    held_out = max(1, round(len(items) * held_out_fraction)) if held_out_fraction else 0
    parts = np.split(order, [held_out, held_out + validation])
    return Split(np.sort(parts[2]), np.sort(parts[1]), np.sort(parts[0]))


def split_recording(recording: Recording, config: TrainingConfig) -> Split:
    """Split the poses of a recording.

    Random poses are split one by one, frames of animation in blocks: an error on a pose would say nothing when the
    frames before and after it have trained. Refined poses and those of the margin all train: they are no sample of the
    range of motion, and an error measured on them would say nothing of it. What is held out stays so when a recording
    is extended. Poses in which the target did not come to rest are in no part, unless they are asked for.

    Raises:
        TrainingError: there are too few poses beside the refined ones.
    """
    sources = recording.info.sampling.sources
    besides = np.concatenate([np.full(s.poses, s.kind == REFINED) for s in sources])
    random = np.concatenate([np.full(s.poses, s.kind == RANDOM) for s in sources])
    around = np.zeros(0, np.int64)
    if margin := recording.info.sampling.margin:
        around = np.flatnonzero(random)[random.sum() - margin.poses :]
        besides[around], random[around] = True, False
    usable = np.ones(len(besides), bool)
    if not config.include_unsettled:
        usable[list(recording.info.unsettled)] = False
    at_rest = int((usable & ~besides).sum())
    if not usable.all() and at_rest < MIN_POSES:
        raise TrainingError(
            f"Only {at_rest} of the {len(usable)} poses of the recording came to rest and training takes at least "
            f"{MIN_POSES}; hold them for more frames (record --max-settle-frames), or take all with "
            "--include-unsettled."
        )
    _check_count(int((~besides).sum()))
    random, around = random & usable, around[usable[around]]
    fractions = config.validation_fraction, config.seed, config.held_out_fraction
    splits = [_split(np.flatnonzero(random), *fractions)] if random.any() else []
    if blocks := _blocks(sources):
        chosen = _split(np.arange(len(blocks)), *fractions)
        splits.append(
            Split(*(_poses_of(blocks, part) for part in (chosen.training, chosen.validation, chosen.held_out)))
        )
    training, validation, held_out = (
        np.sort(np.concatenate([getattr(split, part) for split in splits]))
        for part in ("training", "validation", "held_out")
    )
    return Split(np.append(training, np.flatnonzero(besides & usable)), validation, held_out, around)


def _blocks(sources: tuple[Source, ...]) -> list[list[int]]:
    """Poses by blocks of frames that follow one another; a frame and its mirror image are of one block.

    Short animations have shorter blocks, so that there are some to hold back.
    """
    animated = [source for source in sources if source.kind not in (RANDOM, REFINED)]
    frames = sum({source.name: source.poses for source in animated}.values())
    length = max(1, min(BLOCK_FRAMES, frames // MIN_POSES))
    blocks: dict[tuple[str, int], list[int]] = {}
    pose = 0
    for source in sources:
        if source in animated:
            for number in range(source.poses):
                blocks.setdefault((source.name, number // length), []).append(pose + number)
        pose += source.poses
    return list(blocks.values())


def _poses_of(blocks: list[list[int]], chosen: np.ndarray) -> np.ndarray:
    return np.array([pose for number in chosen for pose in blocks[number]], np.int64)


def held_back_digest(recording: Recording, split: Split) -> str:
    """16 hexadecimal digits that stand for the poses that do not train.

    Equal for two recordings and splits when none of the poses that one of them holds back can have trained the other.
    """
    arrays = (recording.pose_matrices, recording.controls) if recording.rig.controls else (recording.pose_matrices,)
    return Fingerprint.digest(
        *(np.array(array[poses]) for array in arrays for poses in (split.held_out, split.validation))
    )


def residuals_of(recording: Recording, partition: Partition, poses: np.ndarray | None = None) -> np.ndarray:
    """Local residuals of the vertices of a partition, whichever main joints they have, as its own main joint sees them.

    Args:
        recording: of the rig.
        partition: of the recording, or one with vertices of others.
        poses: (n,) indices, all when left out.

    Returns:
        (n, Vp, 3) float32, mesh units.
    """
    vertices, rest_matrices = partition.vertices, recording.rig.rest_matrices
    rows = slice(None) if poses is None else poses
    residuals = recording.residuals[:, vertices] if poses is None else recording.residuals[np.ix_(poses, vertices)]
    main = np.empty(recording.rig.vertex_count, np.int64)
    for own in recording.partitions:
        main[own.vertices] = own.joint
    for joint in np.setdiff1d(main[vertices], partition.joint).tolist():
        pair = [partition.joint, joint]
        skin = skin_matrices(recording.pose_matrices[rows][:, pair], rest_matrices[pair])[:, :, :3, :3]
        seen = np.linalg.inv(skin[:, 0].astype(np.float64)) @ skin[:, 1]
        theirs = main[vertices] == joint
        residuals[:, theirs] = residuals[:, theirs] @ seen.astype(np.float32).transpose(0, 2, 1)
    return residuals


def partitions_of(
    recording: Recording, partitions: Sequence[Partition], inputs: Inputs, turns: bool = False
) -> list[PartitionData]:
    """The partitions of a recording, their features as `inputs` chose them, fitted to turn matrices or not."""
    rig = recording.rig
    features = inputs.features(recording.pose_matrices, rig.rest_matrices, recording.controls)
    matrices = fit_matrices(recording.pose_matrices, rig, turns)
    of_lengths = max(MIN_SPREAD / rig.metres_per_unit, float32_rounding(recording.pose_matrices))
    least = np.where(inputs.are_lengths(), of_lengths, MIN_SPREAD)
    return [
        PartitionData(
            rig.joints[partition.joint].name,
            features[:, inputs.columns[number]],
            lambda partition=partition: residuals_of(recording, partition),
            len(partition.vertices),
            lambda partition=partition: surroundings_of_rig(rig, partition, matrices),
            least[inputs.columns[number]],
        )
        for number, partition in enumerate(partitions)
    ]


def prepare(
    partition: PartitionData, split: Split, tolerance_mm: float, seed: int, metres_per_unit: float = 1.0
) -> PreparedPartition:
    """Standardize the features of a partition and turn its residuals into coefficients.

    What the joints around say is taken off first. Everything is measured on the training poses alone. A partition that
    sees no varying feature gets no shapes: its mean is the best that can be said of it.
    """
    features = partition.features
    training = features[split.training].astype(np.float64)
    scale = training.std(axis=0)
    columns = np.flatnonzero(scale > partition.least_spread).astype(np.int32)
    mean = training[:, columns].mean(axis=0).astype(np.float32)
    scale = scale[columns].astype(np.float32)
    residuals = np.asarray(partition.read_residuals(), np.float32)
    fit = JointFit(np.zeros(0, np.int64), np.zeros((0, partition.vertices), np.float32))
    if partition.read_surroundings:
        surroundings = partition.read_surroundings()
        seen = surroundings if len(columns) else surroundings.alone()
        fit, residuals = seen.fit(residuals, split.training)
    residuals = residuals.reshape(len(features), -1)
    mm_per_unit = 1000 * metres_per_unit
    tolerance = tolerance_mm / mm_per_unit if len(columns) else np.inf
    rng, weights = np.random.default_rng([seed, 2]), split.weights(MARGIN_WEIGHT)
    basis = make_basis(residuals[split.training], tolerance, rng, weights)
    coefficients = basis.coefficients(residuals)
    truncated = residuals[split.validation] - basis.residuals(coefficients[split.validation])
    return PreparedPartition(
        partition.name,
        partition.vertices,
        columns,
        mean,
        scale,
        (features[:, columns] - mean) / scale,
        fit,
        basis,
        coefficients,
        float(np.sqrt(_mean_square(residuals, basis.mean, split.training) / partition.vertices)),
        np.sqrt((truncated**2).sum(axis=1) / partition.vertices),
        split.validation,
        mm_per_unit,
    )


def prepare_together(
    partitions: Sequence[PartitionData],
    split: Split,
    tolerance_mm: float,
    seed: int,
    metres_per_unit: float = 1.0,
    units: int = 0,
    prepared: Callable[[int], None] = lambda done: None,
) -> list[PreparedPartition]:
    """As `prepare`, of partitions that share the tolerance (`share_shapes`).

    Args:
        partitions, split, tolerance_mm, seed, metres_per_unit: as there.
        units: of the last hidden layer.
        prepared: told after each how many are read.
    """
    found = []
    for partition in partitions:
        found.append(prepare(partition, split, tolerance_mm / FINER, seed, metres_per_unit))
        prepared(len(found))
    left, vertices = [own.basis.left for own in found], [own.vertices for own in found]
    tolerance = tolerance_mm / (1000 * metres_per_unit)
    counts = share_shapes(left, vertices, tolerance, units + 1)
    return [
        _made_of_patterns(own.with_shapes(count), partition.read_surroundings, split, tolerance)
        for own, count, partition in zip(found, counts, partitions, strict=True)
    ]


def _made_of_patterns(
    own: PreparedPartition, read_surroundings: Callable[[], Surroundings] | None, split: Split, tolerance: float
) -> PreparedPartition:
    """The same made of patterns, where those are fewer numbers."""
    if not may_have_patterns(own.fit, own.basis):
        return own
    weights, surroundings = split.weights(MARGIN_WEIGHT), read_surroundings()
    found = find_patterns(own.fit, own.basis, own.coefficients, surroundings, split.training, weights, tolerance)
    if found is None:
        return own
    truncation = np.hypot(own.validation_truncation, found.left)
    return replace(
        own,
        fit=found.fit,
        basis=found.basis,
        coefficients=found.coefficients,
        validation_truncation=truncation,
        patterns=found.numbers,
    )


def _mean_square(residuals: np.ndarray, mean: np.ndarray, poses: np.ndarray) -> float:
    """Mean over some of the (N, W) poses of the squared distance from a mean (W,); a block of them at a time."""
    total, step = 0.0, max(1, BLOCK_FLOATS // residuals.shape[1])
    for start in range(0, len(poses), step):
        apart = residuals[poses[start : start + step]].astype(np.float64) - mean
        total += float(np.einsum("nw,nw->", apart, apart))
    return total / len(poses)
