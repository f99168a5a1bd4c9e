# SPDX-License-Identifier: GPL-3.0-or-later
"""Impossible values of training settings are refused, and every setting has an option."""

import argparse
from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.errors import TrainingError
from fdda_addon.core.settings import automatic_passes
from trainer.config import TrainingConfig, add_options, config_from_arguments
from trainer.data.split import Split, split_recording
from trainer.preparation import choose_details

from ..recordings import read_skinned


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
