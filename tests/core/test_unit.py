# SPDX-License-Identifier: GPL-3.0-or-later
"""The length of a mesh unit is stored in recordings and models, and errors in millimeters are computed with it."""

from dataclasses import replace

import pytest

from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.writer import RecordingWriter

from .limb import make_rig, random_poses, random_positions, recording_info


def record_in_unit(path, metres_per_unit: float, complete: int = 6, resume: bool = False):
    """Record the first `complete` of six poses of the limb in a unit, and return the folder."""
    rig = replace(make_rig(), metres_per_unit=metres_per_unit)
    with RecordingWriter(path, rig, recording_info(6), resume) as writer:
        pose_slice = slice(writer.complete, complete)
        writer.append(random_poses(6)[pose_slice], random_positions(6)[pose_slice])
    return path


@pytest.mark.parametrize(("first_unit", "resumed_unit"), [(0.01, 1.0), (1.0, 0.01), (0.01, 0.02)])
def test_a_resumed_recording_keeps_its_unit(tmp_path, first_unit, resumed_unit):
    """The unit may differ when a recording is resumed, because the scale of an object may be animated."""
    record_in_unit(tmp_path / "recording", first_unit, complete=3)
    record_in_unit(tmp_path / "recording", resumed_unit, resume=True)
    assert read_recording(tmp_path / "recording").rig.metres_per_unit == first_unit
