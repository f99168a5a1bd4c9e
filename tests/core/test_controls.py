# SPDX-License-Identifier: GPL-3.0-or-later
"""Controls and merged partitions pass through recordings and models as they are."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.controls import Control
from fdda_addon.core.errors import RecordingError
from fdda_addon.core.model import ModelInfo, ModelPartition
from fdda_addon.core.partition import make_partitions
from fdda_addon.core.recording.extension import RecordingExtension
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from .limb import CHANNELS, make_rig, random_poses, random_residuals, recording_info
from .tiny_model import tiny_info

SMILE = Control("shape_keys", 'key_blocks["Smile"].value', 0.0, 1.0)
FIST = Control("armature_object", 'pose.bones["hand.L"]["fist"]', -1.0, 1.0)
POSES = 6


def values(count: int) -> np.ndarray:
    return np.random.default_rng(3).uniform(-1, 1, (count, 2)).astype(np.float32)


@pytest.fixture
def controlled(tmp_path):
    """A recording with two controls, of which the upper joint's partition has one, and a merged partition."""
    rig = replace(make_rig(), controls=(SMILE, FIST))
    partitions = make_partitions(rig, {0: (1,), 1: (2,)}, {1: (1,)}, {3: 1})
    with RecordingWriter(tmp_path / "recording", rig, partitions, recording_info(POSES)) as writer:
        writer.append(random_poses(POSES), random_residuals(POSES), values(POSES))
    return tmp_path / "recording"


def test_controls_and_merged_partitions_are_read_back(controlled):
    read = read_recording(controlled)
    assert read.rig.controls == (SMILE, FIST)
    assert np.array_equal(read.controls, values(POSES))
    assert [(p.joint, p.influencing, p.controls, p.merged) for p in read.partitions] == [
        (0, (1,), (), ()),
        (1, (2,), (1,), (3,)),
        (2, (), (), ()),
    ]
    plain = make_partitions(make_rig())
    assert sorted(read.partitions[1].vertices) == sorted([*plain[1].vertices, *plain[3].vertices])


def test_a_recording_without_controls_has_an_empty_array(recording):
    assert read_recording(recording).controls.shape == (12, 0)
    assert not (recording / "controls.npy").exists()


def test_an_extension_appends_controls(controlled):
    with RecordingExtension(read_recording(controlled), "model.onnx") as extension:
        extension.append(random_poses(2), random_residuals(2), values(2))
    assert np.array_equal(read_recording(controlled).controls, np.concatenate([values(POSES), values(2)]))


def test_controls_that_are_missing_or_no_numbers_are_refused(controlled):
    array = np.load(controlled / "controls.npy")
    array[2] = np.nan
    np.save(controlled / "controls.npy", array)
    with pytest.raises(RecordingError, match=r"not numbers \(controls"):
        read_recording(controlled)
    (controlled / "controls.npy").unlink()
    with pytest.raises(RecordingError, match=r"controls\.npy' cannot be used"):
        read_recording(controlled)


def test_a_model_says_its_controls():
    info = tiny_info(
        controls=(SMILE, FIST),
        partitions=(
            ModelPartition(0, (), 1, 0),
            ModelPartition(2, (1,), 3, 17, controls=(0, 1), merged=(1,), reassigned=(0, 2)),
        ),
    )
    again = ModelInfo.from_json(info.to_json())
    assert (again.controls, again.partitions) == (info.controls, info.partitions)
    assert "controls" not in tiny_info().to_json()


def test_a_model_with_a_partition_of_an_unknown_control_is_refused():
    info = tiny_info(partitions=(ModelPartition(0, (), 4, 0, controls=(0,)),))
    with pytest.raises(ValueError, match="a control that is none of its controls"):
        ModelInfo.from_json(info.to_json())


def test_names_tell_controls_apart():
    assert SMILE.name == 'shape_keys/key_blocks["Smile"].value'
    assert len({SMILE.name, FIST.name, *(c.name for c in CHANNELS)}) == 4
