# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a unit of the mesh is passes through recordings and models, and figures in mm heed it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.metrics import distances, error_statistics
from fdda_addon.core.model import ModelInfo
from fdda_addon.core.recording.extension import RecordingExtension
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from .damage import edit, refused
from .limb import make_rig, partitions_of, random_poses, random_residuals, record_limb, recording_info
from .tiny_model import tiny_info

BAD = (0, -0.01, float("nan"), float("inf"), "0.01", None, True, [0.01])


def write(path, metres: float, complete: int = 6, resume: bool = False):
    """Record six poses of the limb in a unit, up to so many."""
    rig = replace(make_rig(), metres_per_unit=metres)
    with RecordingWriter(path, rig, partitions_of(rig), recording_info(6), resume) as writer:
        part = slice(writer.complete, complete)
        writer.append(random_poses(6)[part], random_residuals(6)[part])
    return path


def test_a_recording_says_its_unit(tmp_path):
    centimetres = read_recording(write(tmp_path / "centimetres", 0.01))
    assert centimetres.rig.metres_per_unit == 0.01
    metres = read_recording(write(tmp_path / "metres", 1.0))
    assert metres.rig.metres_per_unit == 1.0
    for name in ("pose_matrices", "residuals"):
        assert np.array_equal(getattr(centimetres, name), getattr(metres, name))


@pytest.mark.parametrize("metres", [1.0, 1 + 5e-7, 1 - 5e-7])
def test_a_recording_in_metres_is_as_before(tmp_path, metres):
    record_limb(tmp_path / "before", 6)
    before, after = ((tmp_path / "before" / "recording.json"), write(tmp_path / "after", metres) / "recording.json")
    assert before.read_bytes() == after.read_bytes()
    assert "metres_per_unit" not in after.read_text()


@pytest.mark.parametrize("metres", BAD)
def test_a_recording_in_no_unit(recording, metres):
    edit(recording, metres_per_unit=metres)
    refused(recording, "recording.json' is damaged: 'metres_per_unit' is ", "; record again.")


@pytest.mark.parametrize(("begun", "resumed"), [(0.01, 1.0), (1.0, 0.01), (0.01, 0.02)])
def test_a_recording_ends_in_the_unit_in_which_it_began(tmp_path, begun, resumed):
    """The scale of an object may be animated, and another frame is shown when it goes on."""
    write(tmp_path / "recording", begun, complete=3)
    write(tmp_path / "recording", resumed, resume=True)
    assert read_recording(tmp_path / "recording").rig.metres_per_unit == begun


def test_an_extension_keeps_the_unit(tmp_path):
    with RecordingExtension(read_recording(write(tmp_path / "recording", 0.01)), "model.onnx") as extension:
        extension.append(random_poses(2), random_residuals(2))
    assert read_index(tmp_path / "recording")["metres_per_unit"] == 0.01


def test_a_model_says_its_unit():
    info = tiny_info(metres_per_unit=0.0254)
    assert ModelInfo.from_json(info.to_json()).metres_per_unit == 0.0254
    assert ModelInfo.from_json(tiny_info().to_json()).metres_per_unit == 1.0
    assert "metres_per_unit" not in tiny_info().to_json()


@pytest.mark.parametrize("metres", BAD)
def test_a_model_in_no_unit(metres):
    text = json.dumps({**json.loads(tiny_info().to_json()), "metres_per_unit": metres})
    with pytest.raises(ValueError, match=r"'metres_per_unit' is .*, and must be a number above 0"):
        ModelInfo.from_json(text)


def test_distances_are_metres_in_any_unit():
    first, second = np.zeros((1, 2, 3), np.float32), np.float32([[[0, 0, 0], [0, 30, 40]]])
    found = distances(first, second, 0.01)
    assert found.dtype == np.float32
    assert error_statistics(found).max == pytest.approx(500)
