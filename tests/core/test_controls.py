# SPDX-License-Identifier: GPL-3.0-or-later
"""Controls are written to recordings and models and read back unchanged; influences follow from single moves."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.controls import Control
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import SkinnedRecording, skin_recording
from fdda_addon.core.recording.writer import RecordingExtension, RecordingWriter

from ..recordings import read_skinned, write_recording
from .limb import make_rig, partitions_of, random_poses, random_positions, recording_info

SMILE = Control("shape_keys", 'key_blocks["Smile"].value', 0.0, 1.0)
FIST = Control("armature_object", 'pose.bones["hand.L"]["fist"]', -1.0, 1.0)
POSE_COUNT = 6


def control_values(count: int) -> np.ndarray:
    """Return (count, 2) float32 values of `SMILE` and `FIST`."""
    return np.random.default_rng(3).uniform(-1, 1, (count, 2)).astype(np.float32)


@pytest.fixture
def controlled_recording(tmp_path):
    """Folder of a recording with two controls."""
    rig = replace(make_rig(), controls=(SMILE, FIST))
    with RecordingWriter(tmp_path / "recording", rig, recording_info(POSE_COUNT)) as writer:
        writer.append(random_poses(POSE_COUNT), random_positions(POSE_COUNT), control_values(POSE_COUNT))
    return tmp_path / "recording"


def test_influences_follow_from_poses_in_which_inputs_move_alone(tmp_path):
    """Partitions are merged as the settings of the training say, and keep what influences any of their vertices."""
    rig = replace(make_rig(), controls=(SMILE, FIST))
    partitions = make_partitions(rig, {0: (1,), 1: (2,)}, {1: (1,), 3: (0,)})
    arrays = random_poses(POSE_COUNT), random_positions(POSE_COUNT), control_values(POSE_COUNT)
    write_recording(tmp_path / "r", rig, partitions, recording_info(POSE_COUNT), *arrays)
    skinned = read_skinned(tmp_path / "r", min_vertices_per_part=0)
    assert [(p.joint, p.influencing, p.controls) for p in skinned.partitions] == [
        *((0, (1,), ()), (1, (2,), (1,)), (2, (), ()), (3, (), (0,)))
    ]
    np.testing.assert_allclose(skinned.residuals, arrays[1], atol=1e-5)
    for partition in skinned.partitions:
        residuals = SkinnedRecording.compute_partition_residuals(skinned, partition)
        np.testing.assert_allclose(residuals, skinned.residuals[:, partition.vertices], atol=1e-6)
    (merged,) = read_skinned(tmp_path / "r", min_vertices_per_part=100).partitions
    assert merged.influencing == (1, 2) and merged.controls == (0, 1)
    assert read_skinned(tmp_path / "r", influence_tolerance=2.0).partitions[0].influencing == ()


def test_positions_that_stop_being_finite_are_influenced(tmp_path):
    rig, notes = make_rig(), []
    write_recording(tmp_path / "r", rig, partitions_of(rig), recording_info(6), random_poses(6), random_positions(6))
    positions = np.load(tmp_path / "r" / "positions.npy")
    first_vertex = make_partitions(rig)[3].vertices[0]
    positions[6 + 1 + 0, first_vertex] = np.nan
    np.save(tmp_path / "r" / "positions.npy", positions)
    skinned = skin_recording(read_recording(tmp_path / "r"), min_vertices_per_part=0, note=notes.append)
    assert skinned.partitions[3].influencing == (0,) and len(skinned.rows) == 6
    assert "are not finite in 1 test of its influences, as when 'root' moves from the rest pose" in notes[0]


def test_controls_are_read_back_and_appended(controlled_recording):
    with RecordingExtension(read_recording(controlled_recording), 2, "model.onnx") as extension:
        extension.append(random_poses(2), random_positions(2), control_values(2))
    read_back = read_recording(controlled_recording)
    assert read_back.rig.controls == (SMILE, FIST)
    assert np.array_equal(read_back.controls, np.concatenate([control_values(POSE_COUNT), control_values(2)]))
