# SPDX-License-Identifier: GPL-3.0-or-later
"""The model does not depend on the unit and the position of the character, except for rounding."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.formats.report import report_path
from fdda_addon.core.mathematics.features import FEATURES_PER_JOINT
from fdda_addon.core.mathematics.partition import make_partitions
from trainer.__main__ import main
from trainer.config import TrainingConfig
from trainer.data.split import split_recording
from trainer.inputs.network_inputs import make_inputs
from trainer.preparation import partition_data, prepare_partition

from ..recordings import read_skinned, write_recording
from .chain import chain_angles, chain_info, chain_residuals, chain_rig, pose_chain
from .conftest import QUICK_OPTIONS

JOINTS, POSES = 4, 160
METER = "meters"
UNITS_AND_DISTANCES = {
    METER: (1.0, 0.0),
    "millimeters": (1024.0, 0.0),
    "kilometers": (1 / 1024, 0.0),
    "128 meters away": (1.0, 128.0),
    "millimeters, 128 meters away": (1024.0, 128.0),
}
"""Mesh units per meter, and meters from the origin: powers of two, so that units round alike."""
STABLE_OPTIONS = ("--passes", "80", "--learning-rate", "0.003", "--seed", "1")
"""At the default learning rate, short trainings multiply rounding errors: equal errors then differ by a tenth.
With the default seed, a component near the threshold is dropped at the origin only."""
OTHER_UNITS = [name for name in UNITS_AND_DISTANCES if name != METER]


def write_chain_in_unit(path, units_per_metre: float, origin_distance: float) -> None:
    """Write a recording of the chain in another unit, at a distance from the origin in meters."""
    rig = chain_rig(JOINTS)
    angles = chain_angles(POSES, JOINTS, seed=3)
    matrices, residuals = pose_chain(rig, angles).astype(np.float64), chain_residuals(rig, angles)
    matrices[:, -1, 0, 3] += 0.002 * np.sin(3 * angles[:, -1, 0])  # The last joint slides a little.
    rest_matrices, rest_positions = rig.rest_matrices.astype(np.float64), rig.rest_positions.astype(np.float64)
    for array in (rest_matrices, matrices):
        array[..., :3, 3] = units_per_metre * (array[..., :3, 3] + origin_distance)
    rig = replace(
        rig,
        rest_positions=(units_per_metre * (rest_positions + origin_distance)).astype(np.float32),
        rest_matrices=rest_matrices.astype(np.float32),
        metres_per_unit=1 / units_per_metre,
    )
    influencing = {joint: tuple(other for other in (joint, joint + 1) if 0 < other < JOINTS) for joint in range(JOINTS)}
    write_recording(
        path,
        rig,
        make_partitions(rig, influencing),
        chain_info(POSES),
        matrices.astype(np.float32),
        units_per_metre * residuals,
    )


@pytest.fixture(scope="module")
def results_by_unit(tmp_path_factory) -> dict:
    """Recording, report and model metadata, by name of the unit and distance."""
    folder, results = tmp_path_factory.mktemp("lengths"), {}
    for name, unit_and_distance in UNITS_AND_DISTANCES.items():
        path = folder / name
        path.mkdir()
        write_chain_in_unit(path / "recording", *unit_and_distance)
        model = path / "m.onnx"
        assert main([str(path / "recording"), str(model), *QUICK_OPTIONS, *STABLE_OPTIONS]) == 0, name
        report = json.loads(report_path(model).read_text())
        results[name] = read_skinned(path / "recording"), report, read_model_info(model)
    return results


def prepared(recording) -> list:
    config = TrainingConfig(seed=0)
    rig, split = recording.rig, split_recording(recording, config)
    inputs = make_inputs(rig, recording.partitions)
    partitions = partition_data(recording, inputs)
    return [prepare_partition(p, split, config.detail_mm, config.seed, rig.metres_per_unit) for p in partitions]


@pytest.mark.parametrize("name", OTHER_UNITS)
def test_networks_have_the_same_inputs(results_by_unit, name):
    """Constant features with rounding errors are not inputs, but features that vary a little are inputs."""
    for partition, reference in zip(*(prepared(results_by_unit[n][0]) for n in (name, METER)), strict=True):
        assert partition.columns.tolist() == reference.columns.tolist()
        assert partition.fit.joints.tolist() == reference.fit.joints.tolist()
        assert abs(len(partition.basis.components) - len(reference.basis.components)) <= 1


def test_features_that_vary_like_rounded_keys_are_no_inputs(results_by_unit):
    """Standardization would amplify a rotation by 2e-5 so that rounding errors of the model become visible."""
    recording = results_by_unit[METER][0]
    matrices = np.array(recording.pose_matrices)
    angles = 2e-5 * np.random.default_rng(0).choice([-1.0, 1.0], len(matrices))
    matrices[:, 0, 0, 1], matrices[:, 0, 1, 0] = matrices[:, 0, 0, 1] - angles, matrices[:, 0, 1, 0] + angles
    partitions = tuple(
        replace(partition, influencing=(0, *partition.influencing)) for partition in recording.partitions
    )
    for partition in prepared(replace(recording, pose_matrices=matrices, partitions=partitions)):
        assert len(partition.columns) == 0 or partition.columns.min() >= FEATURES_PER_JOINT


@pytest.mark.parametrize("name", OTHER_UNITS)
def test_models_have_the_same_errors_and_ranges(results_by_unit, name):
    """Another unit changes nothing; far from the origin, positions are only as exact as one step of float32."""
    (_, report, info), (_, reference_report, reference) = results_by_unit[name], results_by_unit[METER]
    units_per_metre, distance = UNITS_AND_DISTANCES[name]
    step, ratio = (1000 * float(np.spacing(np.float32(distance))), 0.1) if distance else (0, 1e-6)
    for method in ("fdda", "linear"):
        expected = pytest.approx(reference_report[method]["held_out"], rel=ratio, abs=step)
        assert report[method]["held_out"] == expected, method
    for bounds in ("feature_low", "feature_high"):
        in_meters = getattr(info, bounds).copy()
        in_meters[:, 3::4] /= units_per_metre
        assert np.abs(in_meters - getattr(reference, bounds))[1:].max() < 2e-4
