# SPDX-License-Identifier: GPL-3.0-or-later
"""The length of a mesh unit is stored in recordings and models, and errors in millimeters are computed with it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.formats.model_info import ModelInfo
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingExtension, RecordingWriter

from .limb import make_rig, random_poses, random_positions, record_limb, recording_info
from .tiny_model import tiny_info

INVALID_LENGTHS = (0, -0.01, float("nan"), float("inf"), "0.01", None, True, [0.01])


def record_in_unit(path, metres_per_unit: float, complete: int = 6, resume: bool = False):
    """Record the first `complete` of six poses of the limb in a unit, and return the folder."""
    rig = replace(make_rig(), metres_per_unit=metres_per_unit)
    with RecordingWriter(path, rig, recording_info(6), resume) as writer:
        pose_slice = slice(writer.complete, complete)
        writer.append(random_poses(6)[pose_slice], random_positions(6)[pose_slice])
    return path


def test_a_recording_stores_its_unit(tmp_path):
    centimeters = read_recording(record_in_unit(tmp_path / "centimeters", 0.01))
    assert centimeters.rig.metres_per_unit == 0.01
    meters = read_recording(record_in_unit(tmp_path / "meters", 1.0))
    assert meters.rig.metres_per_unit == 1.0
    for name in ("pose_matrices", "positions"):
        assert np.array_equal(getattr(centimeters, name), getattr(meters, name))


@pytest.mark.parametrize("metres_per_unit", [1.0, 1 + 5e-7, 1 - 5e-7])
def test_a_recording_in_meters_stores_no_unit(tmp_path, metres_per_unit):
    record_limb(tmp_path / "before", 6)
    expected_index, index = (
        (tmp_path / "before" / "recording.json"),
        record_in_unit(tmp_path / "after", metres_per_unit) / "recording.json",
    )
    assert expected_index.read_bytes() == index.read_bytes()
    assert "metres_per_unit" not in index.read_text()


@pytest.mark.parametrize(("first_unit", "resumed_unit"), [(0.01, 1.0), (1.0, 0.01), (0.01, 0.02)])
def test_a_resumed_recording_keeps_its_unit(tmp_path, first_unit, resumed_unit):
    """The unit may differ when a recording is resumed, because the scale of an object may be animated."""
    record_in_unit(tmp_path / "recording", first_unit, complete=3)
    record_in_unit(tmp_path / "recording", resumed_unit, resume=True)
    assert read_recording(tmp_path / "recording").rig.metres_per_unit == first_unit


def test_an_extension_keeps_the_unit(tmp_path):
    recording = read_recording(record_in_unit(tmp_path / "recording", 0.01))
    with RecordingExtension(recording, 2, "model.onnx") as extension:
        extension.append(random_poses(2), random_positions(2))
    assert read_index(tmp_path / "recording")["metres_per_unit"] == 0.01


def test_model_metadata_contains_the_unit():
    info = tiny_info(metres_per_unit=0.0254)
    assert ModelInfo.from_json(info.to_json()).metres_per_unit == 0.0254
    assert ModelInfo.from_json(tiny_info().to_json()).metres_per_unit == 1.0
    assert "metres_per_unit" not in tiny_info().to_json()


@pytest.mark.parametrize("metres_per_unit", INVALID_LENGTHS)
def test_model_metadata_with_an_invalid_unit_is_refused(metres_per_unit):
    text = json.dumps({**json.loads(tiny_info().to_json()), "metres_per_unit": metres_per_unit})
    with pytest.raises(ValueError, match=r"'metres_per_unit' is .*, and must be a number above 0"):
        ModelInfo.from_json(text)
