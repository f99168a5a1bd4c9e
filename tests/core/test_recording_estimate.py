# SPDX-License-Identifier: GPL-3.0-or-later
"""Disk space and time that a recording will need, and the refusal if the disk has too little space."""

import os
import shutil

import pytest

from fdda_addon.core.errors import OutputError
from fdda_addon.core.recording.estimate import Estimate, check_disk_space, recording_bytes
from fdda_addon.core.recording.reader import read_recording

from .limb import make_rig, record_limb


@pytest.mark.parametrize(
    ("estimate", "sentence"),
    [
        (
            Estimate(2000, 0, 200_612, 4_830_000_000, 12 * 60.0),
            "2,000 poses, each of 200,612 vertices: about 4.8 GB on the disk, about 12 minutes",
        ),
        (Estimate(1, 0, 300, 3600, 0.001), "1 pose, each of 300 vertices: less than 1 MB on the disk, about a second"),
        (
            Estimate(90, 60, 9960, 12_400_000, 80.0),
            "30 poses, and 60 to find what each bone and input moves, each of 9,960 vertices: about 12 MB on the disk, "
            "about 80 seconds",
        ),
        (
            Estimate(9, 0, 9, 10**9, 3 * 3600.0),
            "9 poses, each of 9 vertices: about 1.0 GB on the disk, about 3.0 hours",
        ),
        (Estimate(9, 0, 9, 10**9, None), "9 poses, each of 9 vertices: about 1.0 GB on the disk"),
    ],
)
def test_sentence_about_an_estimate(estimate, sentence):
    assert estimate.sentence() == sentence


def test_estimated_bytes_equal_the_size_of_the_arrays(tmp_path):
    record_limb(tmp_path / "r", poses=50)
    file_bytes = sum(path.stat().st_size for path in (tmp_path / "r").glob("*.npy"))
    header_bytes = 128 * len(list((tmp_path / "r").glob("*.npy")))
    assert recording_bytes(read_recording(tmp_path / "r").rig, 50) == file_bytes - header_bytes


def test_a_disk_with_too_little_space_is_refused(tmp_path):
    free_bytes = shutil.disk_usage(tmp_path).free
    check_disk_space(tmp_path / "a", 1000)
    with pytest.raises(
        OutputError, match=r"Cannot write the recording '.*a.b': it takes .* GB and the disk has .* left"
    ):
        check_disk_space(tmp_path / "a" / "b", free_bytes + 10**9)


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="Windows does not reserve space for files.")
def test_space_that_a_recording_has_reserved_is_not_counted_again(small_disk):
    record_limb(small_disk / "r", poses=20, complete=5)
    needed_bytes = recording_bytes(make_rig(), 20)
    (small_disk / "ballast").write_bytes(b"x" * (shutil.disk_usage(small_disk).free - 8192))
    check_disk_space(small_disk / "r", needed_bytes)
    with pytest.raises(OutputError, match="make room"):
        check_disk_space(small_disk / "other", needed_bytes)
