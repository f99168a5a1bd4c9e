# SPDX-License-Identifier: GPL-3.0-or-later
"""Splits the poses of a recording into training, validation and held-out poses."""

from dataclasses import dataclass, field

import numpy as np

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.recording.index import RANDOM, REFINED, Source
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.rig import Fingerprint
from fdda_addon.core.wording import format_count

from ..config import TrainingConfig

MIN_POSES = 10
OVERSHOOT_POSE_WEIGHT = 0.1
"""Weight of an overshoot pose in the basis; other poses have weight 1. Their residuals are many times as large, but the
components are meant for the range of motion."""
BLOCK_FRAMES = 10
"""Number of consecutive frames that stay in one part of a split, because adjacent frames are nearly the same pose."""


@dataclass(frozen=True)
class Split:
    """Indices of poses, ascending.

    Attributes:
        training: poses from which basis and weights are computed.
        validation: poses that select the best weights.
        held_out: poses that measure the error; nothing is computed from them or selected by them.
        overshoot: the poses of `training` that lie outside the range of motion.
        refined: the poses of `training` that were added where errors were largest.
    """

    training: np.ndarray
    validation: np.ndarray
    held_out: np.ndarray
    overshoot: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    refined: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def weights(self) -> np.ndarray:
        """Return (n,) float64 weights of the training poses: 1, and `OVERSHOOT_POSE_WEIGHT` for overshoot poses."""
        return np.where(np.isin(self.training, self.overshoot), OVERSHOOT_POSE_WEIGHT, 1.0)


def split_poses(poses: np.ndarray, validation_fraction: float, seed: int, held_out_fraction: float = 0.0) -> Split:
    """Split (n,) indices of poses at random; with a fraction of 0 no pose is held out."""
    shuffled_poses = np.random.default_rng([seed, 1]).permutation(poses)
    validation_count = max(1, round(len(poses) * validation_fraction))
    held_out_count = max(1, round(len(poses) * held_out_fraction)) if held_out_fraction else 0
    parts = np.split(shuffled_poses, [held_out_count, held_out_count + validation_count])
    return Split(np.sort(parts[2]), np.sort(parts[1]), np.sort(parts[0]))


def split_recording(recording: SkinnedRecording, config: TrainingConfig) -> Split:
    """Split the poses of a recording.

    Random poses are split one by one. Frames of animation are split in blocks, because the error on a frame is too low
    if adjacent frames are training poses. All refined poses and overshoot poses are training poses, because they do
    not represent the range of motion. Held-out poses stay held out when a recording is extended. Poses in which the
    target did not come to rest are left out, unless the settings include them.

    Raises:
        TrainingError: there are too few poses besides the refined ones.
    """
    sources = recording.info.sampling.sources
    always_trains = np.concatenate([np.full(s.poses, s.kind == REFINED) for s in sources])
    is_refined = always_trains.copy()
    is_random = np.concatenate([np.full(s.poses, s.kind == RANDOM) for s in sources])
    overshoot_poses = np.zeros(0, np.int64)
    if overshoot := recording.info.sampling.overshoot:
        overshoot_poses = np.flatnonzero(is_random)[is_random.sum() - overshoot.poses :]
        always_trains[overshoot_poses], is_random[overshoot_poses] = True, False
    is_usable = np.ones(len(always_trains), bool)
    if not config.include_unsettled:
        is_usable[list(recording.info.unsettled)] = False
    usable_count = int((is_usable & ~always_trains).sum())
    if not is_usable.all() and usable_count < MIN_POSES:
        raise TrainingError(
            f"Only {usable_count} of the {len(is_usable)} poses of the recording came to rest and training takes at "
            f"least {MIN_POSES}; hold them for more frames (record --settle-frames), or take all with "
            "--include-unsettled."
        )
    if (count := int((~always_trains).sum())) < MIN_POSES:
        raise TrainingError(
            f"The recording has {format_count(count, 'pose')} and training takes at least {MIN_POSES}; record more."
        )
    is_random, overshoot_poses = is_random & is_usable, overshoot_poses[is_usable[overshoot_poses]]
    fractions = config.validation_fraction, config.seed, config.held_out_fraction
    splits = [split_poses(np.flatnonzero(is_random), *fractions)] if is_random.any() else []
    if blocks := _frame_blocks(sources):
        selected = split_poses(np.arange(len(blocks)), *fractions)
        parts = (selected.training, selected.validation, selected.held_out)
        splits.append(Split(*(np.array([p for block in part for p in blocks[block]], np.int64) for part in parts)))
    training, validation, held_out = (
        np.sort(np.concatenate([getattr(split, name) for split in splits]))
        for name in ("training", "validation", "held_out")
    )
    training = np.append(training, np.flatnonzero(always_trains & is_usable))
    return Split(training, validation, held_out, overshoot_poses, np.flatnonzero(is_refined & is_usable))


def _frame_blocks(sources: tuple[Source, ...]) -> list[list[int]]:
    """Group the poses of actions into blocks of consecutive frames; a frame and its mirror image share a block.

    Short animations have shorter blocks, so that some can be held out.
    """
    animated = [source for source in sources if source.kind not in (RANDOM, REFINED)]
    frame_count = sum({source.name: source.poses for source in animated}.values())
    length = max(1, min(BLOCK_FRAMES, frame_count // MIN_POSES))
    blocks: dict[tuple[str, int], list[int]] = {}
    first_pose = 0
    for source in sources:
        if source in animated:
            for frame in range(source.poses):
                blocks.setdefault((source.name, frame // length), []).append(first_pose + frame)
        first_pose += source.poses
    return list(blocks.values())


def holdout_fingerprint(recording: SkinnedRecording, split: Split) -> str:
    """Return a digest of 16 hexadecimal digits of the validation and held-out poses.

    If it is equal for two splits, no held-out pose of one is a training pose of the other.
    """
    arrays = (recording.pose_matrices, recording.controls) if recording.rig.controls else (recording.pose_matrices,)
    return Fingerprint.digest(
        *(np.array(array[poses]) for array in arrays for poses in (split.held_out, split.validation))
    )
