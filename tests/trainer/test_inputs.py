# SPDX-License-Identifier: GPL-3.0-or-later
"""The inputs of the networks: features of joints and controls, rotations, and lengths."""

import importlib.util
import json
from dataclasses import replace

import numpy as np
import onnx
import pytest

from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.formats.report import report_path
from fdda_addon.core.mathematics.features import FEATURES_PER_JOINT
from fdda_addon.core.mathematics.partition import Partition, make_partitions
from fdda_addon.core.rig import Rig
from trainer.__main__ import main
from trainer.config import TrainingConfig
from trainer.data.split import split_recording
from trainer.inputs import network_inputs
from trainer.inputs.joints import ControlFeatures, JointFeatures
from trainer.inputs.network_inputs import NetworkInputs, make_inputs
from trainer.inputs.rotations import RotationFeatures
from trainer.model import TrainedModel
from trainer.networks.confidence import MARGIN_RATIO, MIN_MARGINS, measure_training_range
from trainer.preparation import partition_data, prepare_partition

from ..recordings import read_skinned, write_recording
from .chain import chain_angles, chain_info, chain_residuals, chain_rig, pose_chain
from .conftest import QUICK_OPTIONS, REPOSITORY
from .test_graph import check_agreement

PARENTS = np.array([-1, 0, 1, 1, 3])
"""Joint 0 is the parent of joint 1, joint 1 of joints 2 and 3, and joint 3 of joint 4."""


def test_networks_take_the_features_of_influencing_joints_and_controls():
    partitions = [Partition(2, (2, 3), np.zeros(0, np.int32), (0, 2)), Partition(1, (), np.zeros(0, np.int32), (1,))]
    joints = JointFeatures(PARENTS, np.tile(np.eye(4, dtype=np.float32), (5, 1, 1)))
    inputs = NetworkInputs.of([joints, ControlFeatures(3)], partitions)
    assert inputs.columns[0].tolist() == [*range(24, 48), 60, 62]
    assert inputs.columns[1].tolist() == [61]
    poses = np.tile(np.eye(4), (2, 5, 1, 1))
    controls = np.float32([[1, 2, 3], [4, 5, 6]])
    features = inputs.compute_features(poses, controls)
    assert features.shape == (2, 63) and np.array_equal(features[:, 60:63], controls)
    with pytest.raises(ValueError, match=r"are \(2, 0\) and should be \(2, 3\)"):
        inputs.compute_features(poses, np.zeros((2, 0)))


def test_a_block_is_added_as_the_documentation_says(recording, tmp_path, monkeypatch):
    """The block of the chapter is one file and one line in a list; training, export and checkpoint follow."""
    chapter = (REPOSITORY / "docs" / "development.md").read_text("utf-8").partition("\n## A new input\n")[2]
    (tmp_path / "limb_lengths.py").write_text(chapter.partition("```python\n")[2].partition("```")[0], "utf-8")
    specification = importlib.util.spec_from_file_location("trainer.inputs.limb_lengths", tmp_path / "limb_lengths.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    rig, partitions = read_skinned(recording).rig, read_skinned(recording).partitions
    former_counts = np.array([len(columns) for columns in make_inputs(rig, partitions).columns])
    monkeypatch.setattr(network_inputs, "BLOCKS", (*network_inputs.BLOCKS, module.LimbLengths))
    model = tmp_path / "model.onnx"
    assert main([str(recording), str(model), *QUICK_OPTIONS]) == 0, "the graph differs from the reference"
    counts = np.array([len(columns) for columns in make_inputs(rig, partitions).columns])
    assert (counts - former_counts).tolist() == [1, 1, 0]
    assert "limb_lengths" in {node.name for node in onnx.load(model).graph.node}
    assert main([str(recording), str(model), *QUICK_OPTIONS, "--warm-start"]) == 0
    poses = pose_chain(rig, chain_angles(5, 3, 0))
    lengths = make_inputs(rig, partitions).compute_features(poses, np.zeros((5, 0)))[:, -1]
    np.testing.assert_allclose(lengths, np.linalg.norm(poses[:, 2, :3, 3] - poses[:, 0, :3, 3], axis=1), rtol=1e-5)


@pytest.mark.parametrize("is_length", [True, False])
def test_the_margin_of_a_feature_has_its_unit(is_length):
    """Only a length has a margin that depends on the size of the character."""
    rig = chain_rig()
    partitions, poses = make_partitions(rig), pose_chain(rig, chain_angles(20, 3, 0))
    inputs = make_inputs(rig, partitions)
    features = np.append(inputs.compute_features(poses, np.zeros((20, 0))), np.full((20, 1), 0.5, np.float32), axis=1)
    mask = np.append(inputs.length_mask(), is_length)
    training_range = measure_training_range(features, mask, rig, partitions)
    margin = MIN_MARGINS[1] * rig.size if is_length else MIN_MARGINS[0]
    assert training_range.high[-1] - 0.5 == pytest.approx(margin, rel=1e-3)
    spread = np.ptp(features[:, :-1], axis=0)
    widest = int(spread.argmax())
    assert training_range.high[widest] - features[:, widest].max() == pytest.approx(
        MARGIN_RATIO * spread[widest], rel=1e-3
    )


JOINT = 1


def bent_poses(rig: Rig, angles: np.ndarray) -> np.ndarray:
    """Return poses in which only one joint rotates, about x."""
    by_joint = np.zeros((len(angles), len(rig.joints), 2))
    by_joint[:, JOINT, 0] = angles
    return pose_chain(rig, by_joint)


def features_of(rig: Rig, poses: np.ndarray, joint: int = JOINT) -> np.ndarray:
    block = RotationFeatures(rig.parents, rig.rest_matrices, np.array([joint]))
    return block.evaluate(poses, np.zeros((len(poses), 0)))


def test_the_numbers_are_the_axis_times_twice_the_sine_of_half_the_angle():
    rig, angles = chain_rig(), np.radians([-160, -90, -1, 0, 30, 120, 160])
    expected = np.stack([2 * np.sin(angles / 2), *np.zeros((2, len(angles)))], axis=1)
    np.testing.assert_allclose(features_of(rig, bent_poses(rig, angles)), expected, atol=1e-5)
    np.testing.assert_allclose(features_of(rig, bent_poses(rig, angles), joint=2), 0, atol=1e-5)


def test_the_numbers_are_continuous_where_the_axis_changes_its_sign():
    rig, angles = chain_rig(), np.radians(np.arange(0, 361, 0.5))
    features = features_of(rig, bent_poses(rig, angles))
    assert np.isfinite(features).all()
    assert np.abs(np.diff(features, axis=0)).max() < 0.1, "the largest step is 1.8 where 180 degrees is a jump"
    np.testing.assert_allclose(features[angles == np.pi], 0, atol=1e-4)


def test_a_joint_that_has_shrunk_to_nothing_gives_finite_numbers():
    poses = bent_poses(chain_rig(), np.radians([0.0, 30.0]))
    poses[:, 2, :3, :3] = 0
    assert np.isfinite(features_of(chain_rig(), poses, joint=2)).all()


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> dict[str, np.ndarray]:
    """State of a recording: joint 1 is free, 2 scales, 3 rotates by 170 degrees, 4 influences nothing."""
    rig, poses = chain_rig(5), 40
    angles = chain_angles(poses, 5, 0)
    angles[:, 3] = 0
    angles[:, 3, 0] = np.radians(np.linspace(-170, 170, poses))
    matrices = pose_chain(rig, angles)
    matrices[:, 2, :3, 0] *= np.linspace(1, 1.1, poses)[:, None]
    path = tmp_path_factory.mktemp("rotations") / "recording"
    influencing = {0: (1,), 1: (1, 2), 2: (2, 3), 3: (3,)}
    write_recording(
        path,
        rig,
        make_partitions(rig, influencing),
        chain_info(poses),
        matrices.astype(np.float32),
        chain_residuals(rig, angles),
    )
    recording, config = read_skinned(path), TrainingConfig()
    return RotationFeatures.fit(recording, split_recording(recording, config), config)


def test_joints_that_scale_or_turn_far_or_influence_nothing_keep_the_elements(fitted):
    assert {name: array.tolist() for name, array in fitted.items()} == {"joints": [1]}


def test_networks_take_the_numbers_in_place_of_the_elements(fitted):
    rig = chain_rig(5)
    partition = Partition(1, (1, 2), np.zeros(0, np.int32))
    columns = make_inputs(rig, [partition], {"rotations": fitted}).columns[0]
    assert columns.tolist() == [15, 19, 23, *range(24, 36), 60, 61, 62], "the translation, all of joint 2, the numbers"


@pytest.mark.parametrize(
    "state",
    [
        {"joints": np.array([1.0])}, {"joints": np.array([[1]])}, {"joints": np.array([2, 1])},
        {"joints": np.array([-1])}, {"joints": np.array([5])}, {"joints": np.array([1]), "more": np.array([1])},
        {"other": np.array([1])},
    ],
    ids=["numbers", "two dimensions", "unordered", "negative", "no such joint", "more arrays", "another array"],
)  # fmt: skip
def test_a_damaged_state_is_refused(state):
    RotationFeatures.check_state({}, chain_rig(5))
    RotationFeatures.check_state({"joints": np.array([1, 2])}, chain_rig(5))
    with pytest.raises(ValueError, match="rotations"):
        RotationFeatures.check_state(state, chain_rig(5))


@pytest.mark.parametrize("case", ["scaled", "half a turn", "shrunk to nothing"])
def test_the_graph_agrees_with_pytorch_in_poses_that_training_did_not_have(trained_model: TrainedModel, case):
    assert len(trained_model.inputs.states["rotations"]["joints"])
    poses = bent_poses(trained_model.rig, np.radians([150.0, 179.0, 180.0, 181.0]))
    scale = {"scaled": 1.5, "half a turn": 1.0, "shrunk to nothing": 1e-4}[case]
    poses[:, JOINT, :3, :3] *= scale
    confidence = check_agreement(trained_model, poses, tolerance=1e-5)
    assert (confidence < 1).any(), "the elements leave the range of the training"


def test_a_checkpoint_without_rotations_continues_with_the_elements(trained_model: TrainedModel):
    states = {name: state for name, state in trained_model.inputs.states.items() if name != "rotations"}
    former = make_inputs(trained_model.rig, trained_model.partitions, states)
    assert all(set(range(12, 24)) <= set(columns.tolist()) for columns in former.columns[:2])
    assert replace(former).length_mask().sum() == len(trained_model.rig.joints) * 3


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
