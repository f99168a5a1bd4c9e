# SPDX-License-Identifier: GPL-3.0-or-later
"""Random poses and frames of animations are split into training, validation and held-out poses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.mathematics.poses import Overshoot
from fdda_addon.core.recording.index import ACTION, MIRRORED, RANDOM, REFINED, Source
from fdda_addon.core.recording.skinned import SkinnedRecording
from trainer.config import TrainingConfig
from trainer.data.split import BLOCK_FRAMES, Split, split_recording
from trainer.preparation import PartitionData, prepare_partition

from ..recordings import read_skinned
from .chain import write_chain

CONFIG = TrainingConfig(seed=3)
PART_NAMES = ("training", "validation", "held_out")


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> SkinnedRecording:
    path: Path = tmp_path_factory.mktemp("split") / "chain"
    write_chain(path, 4)
    return read_skinned(path)


def split(recording: SkinnedRecording, *sources: Source, config: TrainingConfig = CONFIG) -> Split:
    """Split a recording with some sources, and assert that each pose is in exactly one part."""
    sampling = replace(recording.info.sampling, sources=sources)
    result = split_recording(replace(recording, info=replace(recording.info, sampling=sampling)), config)
    poses = np.concatenate([getattr(result, part) for part in PART_NAMES])
    assert np.array_equal(np.sort(poses), np.arange(sum(s.poses for s in sources)))
    return result


def part_of_each_pose(result: Split, poses: int) -> np.ndarray:
    """Return (poses,) int, index of the part of each pose."""
    parts = np.empty(poses, int)
    for index, part in enumerate(PART_NAMES):
        parts[getattr(result, part)] = index
    return parts


def test_random_poses_are_split_one_by_one(recording):
    result = split(recording, Source(RANDOM, 200))
    order = np.random.default_rng([3, 1]).permutation(200)
    assert np.array_equal(result.held_out, np.sort(order[:20]))
    assert np.array_equal(result.validation, np.sort(order[20:30]))


def test_frames_are_split_in_blocks(recording):
    result = split(recording, Source(ACTION, 400, "walk", (1, 1)))
    blocks = part_of_each_pose(result, 400).reshape(-1, BLOCK_FRAMES)
    assert (blocks == blocks[:, :1]).all()
    assert [(blocks[:, 0] == number).sum() for number in range(3)] == [34, 2, 4]
    split_of_other_seed = split(recording, Source(ACTION, 400, "walk", (1, 1)), config=TrainingConfig(seed=4))
    assert not np.array_equal(result.held_out, split_of_other_seed.held_out)


def test_frames_do_not_change_the_split_of_random_poses(recording):
    expected = part_of_each_pose(split(recording, Source(RANDOM, 100)), 100)
    result = part_of_each_pose(split(recording, Source(RANDOM, 100), Source(ACTION, 120, "walk", (1, 1))), 220)
    assert np.array_equal(result[:100], expected)
    assert set(result[100:]) == {0, 1, 2}


def test_a_frame_and_its_mirror_image_are_in_one_part(recording):
    walk, run = Source(ACTION, 95, "walk", (1, 1)), Source(ACTION, 60, "run", (5, 1))
    sources = (walk, replace(walk, kind=MIRRORED), run, replace(run, kind=MIRRORED))
    parts = part_of_each_pose(split(recording, *sources), 310)
    assert np.array_equal(parts[:95], parts[95:190]) and np.array_equal(parts[190:250], parts[250:])
    assert set(parts[:190]) | set(parts[190:]) == {0, 1, 2}


def test_short_animations_have_shorter_blocks(recording):
    parts = part_of_each_pose(split(recording, Source(ACTION, 34, "nod", (1, 1))), 34)
    runs = np.split(parts, np.arange(3, 34, 3))
    assert all(len(set(run)) == 1 for run in runs) and set(parts) == {0, 1, 2}


def test_all_refined_poses_are_training_poses(recording):
    before = split(recording, Source(ACTION, 100, "walk", (1, 1)))
    after = split(recording, Source(ACTION, 100, "walk", (1, 1)), Source(REFINED, 7, "model.onnx"))
    assert np.array_equal(after.held_out, before.held_out) and np.array_equal(after.validation, before.validation)
    assert np.array_equal(after.training[-7:], np.arange(100, 107))
    assert np.array_equal(after.refined, np.arange(100, 107)) and not len(before.refined)


def test_all_overshoot_poses_are_training_poses(recording):
    sampling = recording.info.sampling
    with_overshoot = replace(sampling, overshoot=Overshoot(2.0, 50, sampling.channels))
    recording_with_overshoot = replace(recording, info=replace(recording.info, sampling=with_overshoot))
    result = split(recording_with_overshoot, Source(RANDOM, 200), Source(ACTION, 100, "walk", (1, 1)))
    assert np.array_equal(result.overshoot, np.arange(150, 200))
    assert np.isin(result.overshoot, result.training).all()
    split_alone = split(recording, Source(RANDOM, 150))
    assert np.array_equal(result.held_out[result.held_out < 200], split_alone.held_out)
    weights = result.weights()
    assert np.array_equal(result.training[weights == 0.1], result.overshoot) and set(weights) == {0.1, 1.0}


def test_too_few_poses_are_refused(recording):
    with pytest.raises(TrainingError, match="has 9 poses and training takes at least 10; record more"):
        split(recording, Source(RANDOM, 4), Source(ACTION, 5, "nod", (1, 1)), Source(REFINED, 50, "model.onnx"))


def test_unsettled_poses_are_left_out_unless_included(recording):
    sampling = replace(recording.info.sampling, sources=(Source(RANDOM, 30),))
    info = replace(recording.info, sampling=sampling, unsettled=tuple(range(0, 30, 3)))
    result = split_recording(replace(recording, info=info), CONFIG)
    poses = np.sort(np.concatenate([getattr(result, part) for part in PART_NAMES]))
    assert np.array_equal(poses, [pose for pose in range(30) if pose % 3])
    split_of_all_poses = split_recording(replace(recording, info=info), replace(CONFIG, include_unsettled=True))
    assert sum(len(getattr(split_of_all_poses, part)) for part in PART_NAMES) == 30
    with pytest.raises(TrainingError, match="Only 4 of the 30 poses of the recording came to rest and training takes"):
        split_recording(replace(recording, info=replace(info, unsettled=tuple(range(26)))), CONFIG)


def test_features_are_standardized_by_the_training_poses_alone():
    features = np.random.default_rng(0).normal(size=(40, 2)).astype(np.float32)
    features[30:] += 10
    split = Split(np.arange(30), np.arange(30, 35), np.arange(35, 40))
    data = PartitionData(features, lambda: np.zeros((40, 5, 3), np.float32))
    prepared = prepare_partition(data, split, 0.1, 0)
    np.testing.assert_allclose(prepared.feature_mean, features[:30].mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(prepared.feature_scale, features[:30].std(axis=0), atol=1e-5)
