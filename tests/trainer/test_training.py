# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings, split, goal, outputs and warnings of a training."""

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.formats.messages import Message, MessageType
from fdda_addon.core.formats.report import Verdict
from fdda_addon.core.mathematics.poses import Overshoot
from fdda_addon.core.recording.index import ACTION, MIRRORED, RANDOM, REFINED, Source
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.settings import automatic_passes
from trainer.__main__ import main
from trainer.config import TrainingConfig, add_options, config_from_arguments
from trainer.data.split import BLOCK_FRAMES, Split, split_recording
from trainer.goal import evaluate_goal
from trainer.preparation import PartitionData, choose_details, prepare_partition

from ..recordings import read_skinned
from .chain import write_chain
from .conftest import QUICK_OPTIONS


@pytest.mark.parametrize(
    "name, value",
    [
        ("passes", -1),
        ("detail_mm", -0.1),
        ("detail_mm", float("nan")),
        ("learning_rate", float("inf")),
        ("hidden", ()),
        ("hidden", (0,)),
        ("activation", "sine"),
        ("validation_fraction", 0.9),
        ("held_out_fraction", 0.0),
        ("goal_mm", -1.0),
        ("seed", -1),
        ("seed", 1 << 63),
        ("batch_size", float("nan")),
        ("include_unsettled", None),
    ],
)
def test_an_impossible_value_is_refused(name, value):
    with pytest.raises(TrainingError, match=f"setting {name} cannot be"):
        TrainingConfig(**{name: value})


@pytest.mark.parametrize("scale, detail_mm", [(0, 0.005), (0.5, None), (100, 0.04)])
@pytest.mark.parametrize("metres_per_unit", [1, 0.01])
def test_the_detail_is_a_part_of_the_error_of_skinning(recording, scale, detail_mm, metres_per_unit):
    source = read_skinned(recording)
    residuals = source.residuals * np.float32(scale / metres_per_unit)
    source = replace(source, rig=replace(source.rig, metres_per_unit=metres_per_unit), residuals=residuals)
    split = split_recording(source, TrainingConfig())
    poses = split.training[:: -(-len(split.training) // 100)]
    rms_mm = 1000 * metres_per_unit * np.sqrt((residuals[poses].astype(np.float64) ** 2).sum(axis=2).mean())
    assert detail_mm or 0.005 < 0.01 * rms_mm < 0.04
    assert choose_details(source, split) == pytest.approx([detail_mm or 0.01 * rms_mm], rel=1e-5)


def test_overshoot_poses_count_a_tenth_in_the_detail_and_each_mesh_has_its_own(recording):
    source = read_skinned(recording)
    meshes = tuple(replace(source.rig.meshes[0], vertices=n) for n in (10, source.rig.vertex_count - 10))
    residuals = np.zeros_like(source.residuals)
    residuals[:, :10, 0], residuals[:, 10:, 0], residuals[::2, :, 0] = 1e-3, 2e-3, 3e-3
    source = replace(source, rig=replace(source.rig, meshes=meshes), residuals=residuals)
    poses = np.arange(20)
    details = choose_details(source, Split(poses, poses[:1], poses[:1], overshoot=poses[::2]))
    assert details == pytest.approx([0.01 * np.sqrt(np.average([9, square], weights=[0.1, 1])) for square in (1, 4)])


def test_the_joints_of_a_wrong_option_are_explained(capsys):
    parser = argparse.ArgumentParser()
    add_options(parser)
    with pytest.raises(SystemExit):
        parser.parse_args(["--bones-to-read", "0"])
    assert "--bones-to-read: joints are auto, all, or a number from 1, and not '0'" in capsys.readouterr().err


def test_every_setting_is_an_option():
    parser = argparse.ArgumentParser()
    add_options(parser)
    option_text = (
        "--seed 3 --detail-mm 0.2 --hidden 8 9 10 --activation gelu --passes 7 --batch-size 5 --learning-rate 0.1 "
        "--weight-decay 0.3 --validation-fraction 0.3 --held-out-fraction 0.2 --goal-mm 0.5 --include-unsettled"
    )
    assert config_from_arguments(parser.parse_args(option_text.split())) == TrainingConfig(
        3, 0.2, (8, 9, 10), "gelu", 7, 5, 0.1, 0.3, 0.3, 0.2, 0.5, True
    )
    assert config_from_arguments(parser.parse_args([])) == TrainingConfig()


@pytest.mark.parametrize("poses, passes", [(1, 200), (1000, 200), (2000, 155), (4000, 120)])
def test_passes_follow_from_the_number_of_poses(poses, passes):
    assert automatic_passes(poses) == passes


CONFIG = TrainingConfig(seed=3)

PART_NAMES = ("training", "validation", "held_out")


@pytest.fixture(scope="module")
def four_poses(tmp_path_factory) -> SkinnedRecording:
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


def test_random_poses_are_split_one_by_one(four_poses):
    result = split(four_poses, Source(RANDOM, 200))
    order = np.random.default_rng([3, 1]).permutation(200)
    assert np.array_equal(result.held_out, np.sort(order[:20]))
    assert np.array_equal(result.validation, np.sort(order[20:30]))


def test_frames_are_split_in_blocks(four_poses):
    result = split(four_poses, Source(ACTION, 400, "walk", (1, 1)))
    blocks = part_of_each_pose(result, 400).reshape(-1, BLOCK_FRAMES)
    assert (blocks == blocks[:, :1]).all()
    assert [(blocks[:, 0] == number).sum() for number in range(3)] == [34, 2, 4]
    split_of_other_seed = split(four_poses, Source(ACTION, 400, "walk", (1, 1)), config=TrainingConfig(seed=4))
    assert not np.array_equal(result.held_out, split_of_other_seed.held_out)


def test_frames_do_not_change_the_split_of_random_poses(four_poses):
    expected = part_of_each_pose(split(four_poses, Source(RANDOM, 100)), 100)
    result = part_of_each_pose(split(four_poses, Source(RANDOM, 100), Source(ACTION, 120, "walk", (1, 1))), 220)
    assert np.array_equal(result[:100], expected)
    assert set(result[100:]) == {0, 1, 2}


def test_a_frame_and_its_mirror_image_are_in_one_part(four_poses):
    walk, run = Source(ACTION, 95, "walk", (1, 1)), Source(ACTION, 60, "run", (5, 1))
    sources = (walk, replace(walk, kind=MIRRORED), run, replace(run, kind=MIRRORED))
    parts = part_of_each_pose(split(four_poses, *sources), 310)
    assert np.array_equal(parts[:95], parts[95:190]) and np.array_equal(parts[190:250], parts[250:])
    assert set(parts[:190]) | set(parts[190:]) == {0, 1, 2}


def test_short_animations_have_shorter_blocks(four_poses):
    parts = part_of_each_pose(split(four_poses, Source(ACTION, 34, "nod", (1, 1))), 34)
    runs = np.split(parts, np.arange(3, 34, 3))
    assert all(len(set(run)) == 1 for run in runs) and set(parts) == {0, 1, 2}


def test_all_refined_poses_are_training_poses(four_poses):
    before = split(four_poses, Source(ACTION, 100, "walk", (1, 1)))
    after = split(four_poses, Source(ACTION, 100, "walk", (1, 1)), Source(REFINED, 7, "model.onnx"))
    assert np.array_equal(after.held_out, before.held_out) and np.array_equal(after.validation, before.validation)
    assert np.array_equal(after.training[-7:], np.arange(100, 107))
    assert np.array_equal(after.refined, np.arange(100, 107)) and not len(before.refined)


def test_all_overshoot_poses_are_training_poses(four_poses):
    sampling = four_poses.info.sampling
    with_overshoot = replace(sampling, overshoot=Overshoot(2.0, 50, sampling.channels))
    recording_with_overshoot = replace(four_poses, info=replace(four_poses.info, sampling=with_overshoot))
    result = split(recording_with_overshoot, Source(RANDOM, 200), Source(ACTION, 100, "walk", (1, 1)))
    assert np.array_equal(result.overshoot, np.arange(150, 200))
    assert np.isin(result.overshoot, result.training).all()
    split_alone = split(four_poses, Source(RANDOM, 150))
    assert np.array_equal(result.held_out[result.held_out < 200], split_alone.held_out)
    weights = result.weights()
    assert np.array_equal(result.training[weights == 0.1], result.overshoot) and set(weights) == {0.1, 1.0}


def test_too_few_poses_are_refused(four_poses):
    with pytest.raises(TrainingError, match="has 9 poses and training takes at least 10; record more"):
        split(four_poses, Source(RANDOM, 4), Source(ACTION, 5, "nod", (1, 1)), Source(REFINED, 50, "model.onnx"))


def test_unsettled_poses_are_left_out_unless_included(four_poses):
    sampling = replace(four_poses.info.sampling, sources=(Source(RANDOM, 30),))
    info = replace(four_poses.info, sampling=sampling, unsettled=tuple(range(0, 30, 3)))
    result = split_recording(replace(four_poses, info=info), CONFIG)
    poses = np.sort(np.concatenate([getattr(result, part) for part in PART_NAMES]))
    assert np.array_equal(poses, [pose for pose in range(30) if pose % 3])
    split_of_all_poses = split_recording(replace(four_poses, info=info), replace(CONFIG, include_unsettled=True))
    assert sum(len(getattr(split_of_all_poses, part)) for part in PART_NAMES) == 30
    with pytest.raises(TrainingError, match="Only 4 of the 30 poses of the recording came to rest and training takes"):
        split_recording(replace(four_poses, info=replace(info, unsettled=tuple(range(26)))), CONFIG)


def test_features_are_standardized_by_the_training_poses_alone():
    features = np.random.default_rng(0).normal(size=(40, 2)).astype(np.float32)
    features[30:] += 10
    split = Split(np.arange(30), np.arange(30, 35), np.arange(35, 40))
    data = PartitionData(features, lambda: np.zeros((40, 5, 3), np.float32))
    prepared = prepare_partition(data, split, 0.1, 0)
    np.testing.assert_allclose(prepared.feature_mean, features[:30].mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(prepared.feature_scale, features[:30].std(axis=0), atol=1e-5)


def evaluate_errors(*errors: float, goal: float = 0.5, training: float = 0.1):
    history = [{"poses": 500 + 250 * index, "p999": error} for index, error in enumerate(errors)]
    return evaluate_goal(goal, history, training, Path("recording"), Path("arm.onnx"))


@pytest.mark.parametrize(
    ("errors", "verdict"),
    [
        ((0.5,), Verdict.MET),
        ((0.51,), Verdict.MISSED),
        ((0.9, 0.8, 0.7), Verdict.MISSED),
        ((0.9, 0.9), Verdict.MISSED),
        ((0.9, 0.89, 0.88), Verdict.EXHAUSTED),
        ((0.9, 0.95, 0.7), Verdict.MISSED),
        ((0.9, 0.95, 0.4), Verdict.MET),
    ],
)
def test_the_errors_determine_the_verdict(errors, verdict):
    assert evaluate_errors(*errors)[0] is verdict


def test_a_missed_goal_gives_advice():
    text = evaluate_errors(0.8)[1]
    assert "within 0.8 mm and the goal is 0.5 mm" in text
    assert "record RIG.blend recording --refine arm.onnx" in text and "--warm-start" in text


def test_an_exhausted_goal_names_the_reason():
    assert "500 more poses brought it there from 0.9 mm" in evaluate_errors(0.9, 0.89, 0.88)[1]
    assert "Narrow the range of motion" in evaluate_errors(0.9, 0.89, 0.88)[1]
    assert (
        "training poses are at 0.85 mm, so the networks are too small"
        in evaluate_errors(0.9, 0.9, 0.9, training=0.85)[1]
    )


@pytest.fixture(scope="module")
def suspicious_recording(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of the chain. Thirty of its 120 poses repeat an earlier pose, one of them with other positions."""
    path = shutil.copytree(recording, tmp_path_factory.mktemp("suspicious") / "recording")
    for name in ("pose_matrices", "positions"):
        array = np.load(path / f"{name}.npy", mmap_mode="r+")
        array[20:51] = array[20]
        if name == "positions":
            array[50, :, 0] += 0.0005
        array.flush()
    return path


WARNING_NAMES = ["duplicate-poses", "hidden-inputs"]


def test_warnings_are_sent_before_the_training_and_reported(suspicious_recording, tmp_path, capsys):
    assert main([str(suspicious_recording), str(tmp_path / "m.onnx"), *QUICK_OPTIONS[2:], "--passes", "2"]) == 0
    messages = [Message.decode(line) for line in capsys.readouterr().out.splitlines()]
    log = MessageType.LOG
    first_message_types = [MessageType.STARTED, log, *[MessageType.WARNING] * 2, log, MessageType.PREPARING]
    assert [m.type for m in messages[:6]] == first_message_types
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert [w["name"] for w in report["warnings"]] == WARNING_NAMES
    assert [m.values for m in messages[2:4]] == report["warnings"]
    assert report["warnings"][0]["text"].startswith("30 of 120 poses repeat an earlier one, such as pose 21 pose 20")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<h2>Warnings</h2>" in page and page.count("<dt>hidden-inputs</dt>") == 1
    assert "Poses 20 and 50 have the same joints and controls" in page


def test_a_strict_training_fails_before_it_starts(suspicious_recording, tmp_path, capsys):
    assert main([str(suspicious_recording), str(tmp_path / "m.onnx"), "--strict", *QUICK_OPTIONS]) == 1
    output = capsys.readouterr()
    assert output.err.startswith("30 of 120 poses repeat an earlier one, such as pose 21 pose 20: ")
    assert output.err.endswith(" (duplicate-poses; 1 more: hidden-inputs).\n")
    assert output.err.count("\n") == 1
    assert '{"type": "warning", "name": "hidden-inputs", "text": ' in output.out
    assert ("epoch" in output.out, list(tmp_path.iterdir())) == (False, [])
