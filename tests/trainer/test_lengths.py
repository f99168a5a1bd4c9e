# SPDX-License-Identifier: GPL-3.0-or-later
"""The model does not depend on the unit and the position of the character, except for rounding."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.checks.recording import check_recording
from fdda_addon.core.model import read_model_info
from fdda_addon.core.partition import make_partitions
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.core.report import report_path
from trainer.__main__ import main
from trainer.config import TrainingConfig
from trainer.data import partition_data, prepare_partition
from trainer.inputs import inputs_of_rig, partition_centers
from trainer.splitting import split_recording

from .chain import chain_angles, chain_info, chain_residuals, chain_rig, pose_chain
from .conftest import QUICK

JOINTS, POSES = 4, 160
METER = "meters"
UNITS_AND_DISTANCES = {
    METER: (1.0, 0.0),
    "centimeters": (100.0, 0.0),
    "millimeters": (1000.0, 0.0),
    "kilometers": (0.001, 0.0),
    "100 meters away": (1.0, 100.0),
    "millimeters, 100 meters away": (1000.0, 100.0),
}
OTHER_UNITS = [name for name in UNITS_AND_DISTANCES if name != METER]


def write_recording(path, per_metre: float, away: float) -> None:
    """Write a recording of the chain in another unit, at a distance from the origin in meters."""
    rig = chain_rig(JOINTS)
    angles = chain_angles(POSES, JOINTS, seed=3)
    matrices, residuals = pose_chain(rig, angles).astype(np.float64), chain_residuals(rig, angles)
    matrices[:, -1, 0, 3] += 0.002 * np.sin(3 * angles[:, -1, 0])  # The last joint slides a little.
    rest, positions = rig.rest_matrices.astype(np.float64), rig.rest_positions.astype(np.float64)
    for array in (rest, matrices):
        array[..., :3, 3] = per_metre * (array[..., :3, 3] + away)
    rig = replace(
        rig,
        rest_positions=(per_metre * (positions + away)).astype(np.float32),
        rest_matrices=rest.astype(np.float32),
        metres_per_unit=1 / per_metre,
    )
    influencing = {j: tuple(i for i in (j, j + 1) if 0 < i < JOINTS) for j in range(JOINTS)}
    with RecordingWriter(path, rig, make_partitions(rig, influencing), chain_info(POSES)) as writer:
        writer.append(matrices.astype(np.float32), per_metre * residuals)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> dict:
    """Recording, report and model metadata for each unit and distance."""
    folder, found = tmp_path_factory.mktemp("lengths"), {}
    for name, way in UNITS_AND_DISTANCES.items():
        path = folder / name
        path.mkdir()
        write_recording(path / "recording", *way)
        model = path / "m.onnx"
        assert main([str(path / "recording"), str(model), *QUICK]) == 0, name
        report = json.loads(report_path(model).read_text())
        found[name] = read_recording(path / "recording"), report, read_model_info(model)
    return found


def prepared(recording) -> list:
    config = TrainingConfig(seed=0)
    rig, split = recording.rig, split_recording(recording, config)
    inputs = inputs_of_rig(rig, partition_centers(rig, recording.partitions), recording.partitions)
    partitions = partition_data(recording, recording.partitions, inputs)
    return [prepare_partition(p, split, config.tolerance_mm, config.seed, rig.metres_per_unit) for p in partitions]


@pytest.mark.parametrize("name", OTHER_UNITS)
def test_networks_have_the_same_inputs(trained, name):
    """Constant features with rounding errors are not inputs; features that vary a little are."""
    for own, meters in zip(*(prepared(trained[n][0]) for n in (name, METER)), strict=True):
        assert own.columns.tolist() == meters.columns.tolist()
        assert own.fit.joints.tolist() == meters.fit.joints.tolist()
        assert abs(len(own.basis.components) - len(meters.basis.components)) <= 1


@pytest.mark.parametrize("name", OTHER_UNITS)
def test_models_have_the_same_errors(trained, name):
    own, meters = (trained[n][1] for n in (name, METER))
    # One step of float32, mm: positions far from the origin are no more exact than that.
    step = 1000 * float(np.spacing(np.float32(UNITS_AND_DISTANCES[name][1])))
    for way in ("fdda", "linear"):
        for statistic, value in meters[way]["held_out"].items():
            assert own[way]["held_out"][statistic] == pytest.approx(value, rel=0.1, abs=step), (way, statistic)


@pytest.mark.parametrize("name", OTHER_UNITS)
def test_training_ranges_agree_in_meters(trained, name):
    """The bounds that determine the confidence are equal in meters."""
    (_, _, own), (_, _, meters) = trained[name], trained[METER]
    per_metre, _ = UNITS_AND_DISTANCES[name]
    for mine, theirs in ((own.feature_low, meters.feature_low), (own.feature_high, meters.feature_high)):
        mine = mine.copy()
        mine[:, 3::4] /= per_metre
        assert np.abs(mine - theirs)[1:].max() < 2e-4


@pytest.mark.parametrize("name", UNITS_AND_DISTANCES)
def test_recording_checks_give_the_same_warnings(trained, name):
    own, meters = ({warning.name for warning in check_recording(trained[n][0])} for n in (name, METER))
    assert own == meters
