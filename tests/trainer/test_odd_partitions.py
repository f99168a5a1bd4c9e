# SPDX-License-Identifier: GPL-3.0-or-later
"""Merged partitions and vertices without a bone are trained and evaluated like other partitions."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.formats.model import read_model_info
from fdda_addon.core.mathematics.metrics import distances
from fdda_addon.core.mathematics.partition import Partition, main_joints, make_partitions
from fdda_addon.core.mathematics.skinning import LinearSkinning, skin_matrices
from fdda_addon.core.rig import STATIC_JOINT, Joint, Rig
from fdda_addon.runtime.network import Network
from trainer.__main__ import main
from trainer.fits.joint_fit import joint_regression, joints_on_path

from ..recordings import write_recording
from .chain import chain_angles, chain_info, chain_rig, pose_chain
from .conftest import QUICK_OPTIONS

POSES, JOINTS = 120, 4
STATIC_JOINT_INDEX = JOINTS
MERGED_JOINT, ABSORBING_JOINT = 3, 2
INFLUENCING = {0: (0, 1), 1: (0, 1, 2, 3), ABSORBING_JOINT: (2, 3), STATIC_JOINT_INDEX: (0, 1)}


def odd_rig() -> Rig:
    """Create a chain of four joints; the vertices of its first tenth have no bone, and the last bone has 7."""
    rig = chain_rig(JOINTS)
    skin_joints, skin_weights = rig.skin_joints.copy(), rig.skin_weights.copy()
    has_no_bone = rig.rest_positions[:, 2] < 0.1
    skin_joints[has_no_bone], skin_weights[has_no_bone] = [STATIC_JOINT_INDEX, 0], [1, 0]
    is_below_tip = main_joints(skin_joints, skin_weights) == MERGED_JOINT
    is_below_tip &= rig.rest_positions[:, 2] < np.sort(rig.rest_positions[:, 2])[-7]
    skin_joints[is_below_tip], skin_weights[is_below_tip] = [ABSORBING_JOINT, 0], [1, 0]
    rest_matrices = np.append(rig.rest_matrices, np.eye(4, dtype=np.float32)[None], axis=0)
    joints = (*rig.joints, Joint(STATIC_JOINT, -1))
    return replace(rig, joints=joints, rest_matrices=rest_matrices, skin_joints=skin_joints, skin_weights=skin_weights)


def odd_partitions(rig: Rig) -> tuple[Partition, ...]:
    return make_partitions(rig, INFLUENCING, merged={MERGED_JOINT: ABSORBING_JOINT})


def odd_poses(rig: Rig, poses: int, seed: int) -> np.ndarray:
    angles = np.concatenate([chain_angles(poses, JOINTS, seed), np.zeros((poses, 1, 2))], axis=1)
    # The root rotates, and vertices without a bone do not move.
    angles[:, 0] = np.random.default_rng([seed, 1]).uniform(-0.5, 0.5, (poses, 2))
    return pose_chain(rig, angles)


def smoothed(rig: Rig, poses: np.ndarray) -> np.ndarray:
    """Return (N, V, 3) positions where every vertex follows nearby joints with smoother weights than the rig's."""
    height = rig.rest_positions[:, 2, None] * JOINTS
    weights = np.exp(-(((height - np.arange(JOINTS) - 0.5) / 0.6) ** 2))
    weights = np.concatenate([weights, np.exp(-((height / 0.6) ** 2))], axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    rest = np.append(rig.rest_positions, np.ones((rig.vertex_count, 1)), axis=1)
    return np.einsum("vj,njab,vb->nva", weights, skin_matrices(poses, rig.rest_matrices)[:, :, :3], rest)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    folder, rig = tmp_path_factory.mktemp("odd"), odd_rig()
    partitions, poses = odd_partitions(rig), odd_poses(rig, POSES, 0)
    write_recording(
        folder / "recording",
        rig,
        partitions,
        chain_info(POSES),
        poses,
        LinearSkinning(rig, partitions).local_residuals(poses, smoothed(rig, poses)),
    )
    assert main([str(folder / "recording"), str(folder / "model.onnx"), *QUICK_OPTIONS]) == 0
    return folder / "model.onnx"


def test_every_partition_approximates_unseen_poses(model):
    rig = odd_rig()
    poses, partitions = odd_poses(rig, 40, 9), odd_partitions(rig)
    positions, truth = Network(model).positions(poses), smoothed(rig, poses)
    error, linear = distances(positions, truth), distances(LinearSkinning(rig).positions(poses), truth)
    for partition in partitions:
        assert error[:, partition.vertices].mean() < 0.1 * linear[:, partition.vertices].mean()
    main_joint = main_joints(rig.skin_joints, rig.skin_weights)
    for joint in (MERGED_JOINT, STATIC_JOINT_INDEX):
        is_own_vertex = main_joint == joint
        assert is_own_vertex.sum() > 5 and error[:, is_own_vertex].mean() < 0.1 * linear[:, is_own_vertex].mean()


def test_model_and_report_name_merged_joints(model):
    info, report = read_model_info(model), json.loads(model.with_name("report.json").read_text())
    assert [(p.joint, p.merged) for p in info.partitions] == [(0, ()), (1, ()), (2, (3,)), (4, ())]
    assert sum(p.vertices for p in info.partitions) == info.vertex_count
    names = [(p["joint"], p.get("merged")) for p in report["partitions"]]
    assert names == [("bone_0", None), ("bone_1", None), ("bone_2", ["bone_3"]), (STATIC_JOINT, None)]
    # The residuals of merged vertices are in the space of the absorbing joint, so their errors are small.
    assert all(p["held_out"]["mean"] < 0.1 * p["linear"]["mean"] for p in report["partitions"])
    page = model.with_name("report.html").read_text()
    assert '<td title="with bone_3">bone_2</td>' in page and ">no bone</td>" in page


def test_vertices_without_a_bone_are_fitted_to_influencing_joints():
    rig = odd_rig()
    partitions = odd_partitions(rig)
    skin = skin_matrices(odd_poses(rig, 3, 0), rig.rest_matrices)
    assert joint_regression(rig, partitions[3], skin).joints.tolist() == [STATIC_JOINT_INDEX, 0, 1]
    assert joint_regression(rig, partitions[0], skin).joints.tolist() == [0, 1, STATIC_JOINT_INDEX]
    assert joint_regression(rig, partitions[2], skin).joints.tolist() == [2, 1, 3]


def test_the_path_between_two_roots_has_all_joints_up_to_both():
    parents = np.array([-1, 0, 1, -1, 3])
    assert joints_on_path(parents, 2, 4) == joints_on_path(parents, 4, 2) == {0, 1, 2, 3, 4}
    assert joints_on_path(parents, 0, 3) == {0, 3} and joints_on_path(parents, 1, 3) == {0, 1, 3}
    assert joints_on_path(parents, 2, 0) == {1, 2}
