# SPDX-License-Identifier: GPL-3.0-or-later
"""What a recording will take: the sentence, the bytes, and the refusal of a disk without room."""

import os
import shutil

import pytest

from fdda_addon.core.errors import OutputError
from fdda_addon.core.recording.estimate import Estimate, check_disk_space, recording_bytes, training_size_sentence
from fdda_addon.core.recording.reader import read_recording

from .limb import make_rig, record_limb


@pytest.mark.parametrize(
    ("estimate", "sentence"),
    [
        (
            Estimate(2000, 200_612, 4_830_000_000, 12 * 60.0),
            "2,000 poses of 200,612 vertices: about 4.8 GB on the disk, about 12 minutes",
        ),
        (Estimate(1, 300, 3600, 0.001), "1 pose of 300 vertices: less than 1 MB on the disk, about a second"),
        (Estimate(90, 9960, 12_400_000, 80.0), "90 poses of 9,960 vertices: about 12 MB on the disk, about 80 seconds"),
        (Estimate(9, 9, 10**9, 3 * 3600.0), "9 poses of 9 vertices: about 1.0 GB on the disk, about 3.0 hours"),
        (Estimate(9, 9, 10**9, None), "9 poses of 9 vertices: about 1.0 GB on the disk"),
    ],
)
def test_the_sentence(estimate, sentence):
    assert estimate.sentence() == sentence


def test_the_bytes_are_those_of_the_files(tmp_path):
    record_limb(tmp_path / "r", poses=50)
    written = sum(path.stat().st_size for path in (tmp_path / "r").glob("*.npy"))
    headers = 128 * len(list((tmp_path / "r").glob("*.npy")))
    assert recording_bytes(read_recording(tmp_path / "r").rig, 50) == written - headers


def test_what_a_training_takes(tmp_path):
    record_limb(tmp_path / "r", poses=50)
    recording = read_recording(tmp_path / "r")
    largest = max(recording.partitions, key=lambda partition: len(partition.vertices))
    name = recording.rig.joint_names[largest.joint]
    assert training_size_sentence(recording) == (
        f"50 poses of {recording.rig.vertex_count} vertices: less than 1 MB on the disk; residuals of the largest "
        f"partition, '{name}', of {len(largest.vertices)} vertices: less than 1 MB, in memory two or three times."
    )


def test_a_disk_without_room(tmp_path):
    free = shutil.disk_usage(tmp_path).free
    check_disk_space([(tmp_path / "a", 1000), (tmp_path / "b", 1000)])
    with pytest.raises(
        OutputError, match=r"Cannot write the recording '.*a.b': it takes .* GB and the disk has .* left"
    ):
        check_disk_space([(tmp_path / "a" / "b", free), (tmp_path / "c", 10**9)])


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="Windows reserves no room for files.")
def test_what_a_recording_has_already_needs_no_room(small_disk):
    record_limb(small_disk / "r", poses=20, complete=5)
    size = recording_bytes(make_rig(), 20)
    (small_disk / "ballast").write_bytes(b"x" * (shutil.disk_usage(small_disk).free - 8192))
    check_disk_space([(small_disk / "r", size)])
    with pytest.raises(OutputError, match="make room"):
        check_disk_space([(small_disk / "other", size)])
