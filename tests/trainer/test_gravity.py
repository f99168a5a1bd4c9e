# SPDX-License-Identifier: GPL-3.0-or-later
"""The training detects whether a surface from a file or a simulation depends on gravity."""

from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.partition import assume_nearby_influences, make_partitions
from fdda_addon.core.recording.index import RecordingInfo, Sampling, Source
from fdda_addon.core.recording.reader import Recording
from fdda_addon.core.recording.target import FRAMES, POSE, SIMULATION, RecordedTarget
from trainer.data.split import Split
from trainer.fits.gravity import drop_gravity_input

from .chain import MAX_ANGLE, chain_residuals, chain_rig, pose_chain

POSES = 200
GRAVITY_DIRECTION = np.array([0.0, 0.0, -1.0])


def record_sagging_chain(follows: str, sag: float) -> Recording:
    """Create a recording of a chain that bends and rotates, and whose surface sags by `sag` meters."""
    rig = chain_rig(joint_count=4)
    angles = np.random.default_rng(0).uniform(-MAX_ANGLE, MAX_ANGLE, (POSES, 4, 2))
    matrices = pose_chain(rig, angles)
    residuals = chain_residuals(rig, angles)
    bare_partitions = make_partitions(rig, {joint: () for joint in range(4)})
    for partition in bare_partitions:
        rotations = matrices[:, partition.joint, :3, :3] @ rig.rest_matrices[partition.joint, :3, :3].T
        residuals[:, partition.vertices] += (sag * GRAVITY_DIRECTION @ rotations).astype(np.float32)[:, None]
    info = RecordingInfo(
        POSES, POSES, "chain.blend", "chain", "5.2.0", Sampling(0, 1.0, (), (Source("random", POSES),)),
        target=RecordedTarget("flesh", follows, 0),
    )  # fmt: skip
    partitions = assume_nearby_influences(rig, bare_partitions)
    return Recording(Path(), info, rig, partitions, matrices, residuals, np.zeros((POSES, 0), np.float32))


def make_split() -> Split:
    return Split(np.arange(0, 160), np.arange(160, 180), np.arange(180, POSES))


@pytest.mark.parametrize("follows", [FRAMES, SIMULATION])
def test_without_sag_the_gravity_input_is_dropped(follows):
    result = drop_gravity_input(record_sagging_chain(follows, sag=0.0), make_split())
    assert [partition.influencing for partition in result.partitions] == [(1,), (1, 2), (1, 2, 3), (1, 2, 3)]


@pytest.mark.parametrize("follows", [FRAMES, SIMULATION])
def test_with_sag_the_gravity_input_stays(follows):
    recording = record_sagging_chain(follows, sag=0.01)
    assert [partition.influencing for partition in recording.partitions] == [
        (0, 1),
        (0, 1, 2),
        (0, 1, 2, 3),
        (0, 1, 2, 3),
    ]
    assert drop_gravity_input(recording, make_split()) is recording


def test_a_target_that_follows_the_pose_keeps_its_influences():
    recording = record_sagging_chain(POSE, sag=0.0)
    assert drop_gravity_input(recording, make_split()) is recording


def test_held_out_poses_are_not_used():
    recording = record_sagging_chain(FRAMES, sag=0.0)
    recording.residuals[make_split().held_out] = np.nan
    assert drop_gravity_input(recording, make_split()) is not recording


def test_joints_of_several_roots_keep_their_influences():
    rig = chain_rig(joint_count=2)
    rig_with_two_roots = type(rig)(
        tuple(type(joint)(joint.name, -1) for joint in rig.joints), rig.rest_positions, rig.rest_matrices,
        rig.skin_joints, rig.skin_weights, rig.fingerprint, rig.face_starts, rig.face_vertices,
    )  # fmt: skip
    result = assume_nearby_influences(
        rig_with_two_roots, make_partitions(rig_with_two_roots, {0: (), 1: ()}), may_sag=False
    )
    assert [partition.influencing for partition in result] == [(0, 1), (0, 1)]
