# SPDX-License-Identifier: GPL-3.0-or-later
"""The networks take the rotation of a joint without scale as three numbers."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.mathematics.partition import Partition, make_partitions
from fdda_addon.core.rig import Rig
from trainer.config import TrainingConfig
from trainer.data.split import split_recording
from trainer.inputs.network_inputs import make_inputs
from trainer.inputs.rotations import RotationFeatures
from trainer.model import TrainedModel

from ..recordings import read_skinned, write_recording
from .chain import chain_angles, chain_info, chain_residuals, chain_rig, pose_chain
from .test_graph import check_agreement, trained_model  # noqa: F401, the fixture

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
def test_the_graph_agrees_with_pytorch_in_poses_that_training_did_not_have(trained_model: TrainedModel, case):  # noqa: F811
    assert len(trained_model.inputs.states["rotations"]["joints"])
    poses = bent_poses(trained_model.rig, np.radians([150.0, 179.0, 180.0, 181.0]))
    scale = {"scaled": 1.5, "half a turn": 1.0, "shrunk to nothing": 1e-4}[case]
    poses[:, JOINT, :3, :3] *= scale
    confidence = check_agreement(trained_model, poses, tolerance=1e-5)
    assert (confidence < 1).any(), "the elements leave the range of the training"


def test_a_checkpoint_without_rotations_continues_with_the_elements(trained_model: TrainedModel):  # noqa: F811
    states = {name: state for name, state in trained_model.inputs.states.items() if name != "rotations"}
    former = make_inputs(trained_model.rig, trained_model.partitions, states)
    assert all(set(range(12, 24)) <= set(columns.tolist()) for columns in former.columns[:2])
    assert replace(former).length_mask().sum() == len(trained_model.rig.joints) * 3
