# SPDX-License-Identifier: GPL-3.0-or-later
"""The inputs of the networks that depend on joints."""

import importlib.util

import numpy as np
import onnx
import pytest

from fdda_addon.core.mathematics.partition import Partition, make_partitions
from trainer.__main__ import main
from trainer.inputs import network_inputs
from trainer.inputs.joints import ControlFeatures, JointFeatures
from trainer.inputs.network_inputs import NetworkInputs, make_inputs
from trainer.networks.confidence import MARGIN_RATIO, MIN_MARGINS, measure_training_range

from ..recordings import read_skinned
from .chain import chain_angles, chain_rig, pose_chain
from .conftest import QUICK_OPTIONS, REPOSITORY

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
