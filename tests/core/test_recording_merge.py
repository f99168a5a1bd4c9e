# SPDX-License-Identifier: GPL-3.0-or-later
"""Merged shards have the same bytes as one recording, in any order of the shards and after an interruption."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.errors import OutputError, RecordingError
from fdda_addon.core.recording import merge, writer
from fdda_addon.core.recording.index import INDEX_NAME, read_index
from fdda_addon.core.recording.merge import merge_recordings
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.shard import Shard, shard_poses
from fdda_addon.core.recording.writer import RecordingWriter

from .limb import make_rig, partitions_of, random_poses, random_residuals, record_limb, recording_info

POSE_COUNT, SHARD_COUNT = 12, 5


def record_shard(path: Path, poses: range, seed: int = 0) -> Path:
    """Record these poses of the limb as a shard and return its folder."""
    rig, info = (
        make_rig(),
        replace(recording_info(POSE_COUNT, seed), poses=len(poses), shard=Shard(poses.start, POSE_COUNT)),
    )
    with RecordingWriter(path, rig, partitions_of(rig), info) as shard:
        pose_slice = slice(poses.start, poses.stop)
        shard.append(random_poses(POSE_COUNT)[pose_slice], random_residuals(POSE_COUNT)[pose_slice])
    return path


@pytest.fixture
def shards(tmp_path: Path) -> list[Path]:
    """Folders of `SHARD_COUNT` shards, after one of a shard without poses."""
    pose_ranges = [shard_poses(number, SHARD_COUNT, POSE_COUNT) for number in range(1, SHARD_COUNT + 1)]
    return [
        record_shard(tmp_path / f"s{number}", pose_range) for number, pose_range in enumerate([range(0), *pose_ranges])
    ]


def merge_shards(shards: list[Path], path: Path) -> Path:
    """Merge the shards, check that all poses are done, and return the folder of the recording."""
    assert [step.done for step in merge_recordings(shards, path)][-1] == POSE_COUNT
    return path


def file_bytes(folder: Path) -> dict[str, bytes]:
    """Return the bytes of each file of the folder by its name."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(("count", "total"), [(1, 1), (1, 7), (3, 7), (7, 7), (9, 7), (64, 1000)])
def test_each_pose_is_in_one_shard(count, total):
    pose_ranges = [shard_poses(number, count, total) for number in range(1, count + 1)]
    assert [pose for pose_range in pose_ranges for pose in pose_range] == list(range(total))
    assert max(map(len, pose_ranges)) - min(map(len, pose_ranges)) <= 1


@pytest.mark.parametrize("chunk_bytes", [1, 3 * 4 * (40 * 3 + 4 * 16), 1 << 24])
def test_merged_shards_equal_one_recording(shards, tmp_path, monkeypatch, chunk_bytes):
    monkeypatch.setattr(merge, "COPY_CHUNK_BYTES", chunk_bytes)
    record_limb(tmp_path / "whole", POSE_COUNT)
    path = merge_shards([shards[n] for n in (3, 5, 0, 1, 4, 2)], tmp_path / "merged")
    assert file_bytes(path) == file_bytes(tmp_path / "whole")
    read_recording(path)


def test_an_interrupted_merge_continues_without_repeating_poses(shards, tmp_path, monkeypatch):
    monkeypatch.setattr(merge, "COPY_CHUNK_BYTES", 1)
    path, first_appended_poses = tmp_path / "merged", []
    append = writer.RecordingWriter.append
    monkeypatch.setattr(
        writer.RecordingWriter,
        "append",
        lambda self, *arrays: (first_appended_poses.append(self.complete), append(self, *arrays)),
    )
    steps = merge_recordings(shards, path)
    while next(steps).done < 7:
        pass
    steps.close()
    assert read_index(path)["complete"] == 7
    merge_shards(shards, path)
    bytes_before = file_bytes(path)
    merge_shards(shards, path)
    record_limb(tmp_path / "whole", POSE_COUNT)
    assert first_appended_poses[:POSE_COUNT] == list(range(POSE_COUNT))
    assert file_bytes(path) == bytes_before == file_bytes(tmp_path / "whole")


def merge_error(shards: list[Path], path: Path) -> str:
    """Check that merging the shards is refused and writes nothing; return the sentence."""
    with pytest.raises(RecordingError) as error:
        list(merge_recordings(shards, path))
    assert not path.exists()
    return str(error.value)


def test_missing_and_repeated_poses_are_named(shards, tmp_path):
    path = tmp_path / "merged"
    assert merge_error([*shards[:2], *shards[4:]], path) == (
        f"Poses 2 to 6 of {POSE_COUNT} are in none of the 4 shards; give all of them."
    )
    assert merge_error(shards[:5], path).startswith("Poses 9 to 11 of 12 are in none of the 5 shards")
    assert merge_error(shards[:1], path).startswith("Poses 0 to 11 of 12 are in none of the 1 shards")
    assert merge_error([*shards, shards[2]], path) == (
        f"'{shards[2]}' and '{shards[2]}' have poses in common; give each shard once."
    )
    assert merge_error([], path) == "There is nothing to merge; give the folders of the shards."
    assert "'none' is not a recording" in merge_error([*shards, tmp_path / "none"], path).replace(
        f"{tmp_path}{os.sep}", ""
    )


def test_shards_of_other_recordings_are_refused(shards, tmp_path):
    path = tmp_path / "merged"
    other_shard = record_shard(tmp_path / "other", range(9, 12), seed=4)
    assert "recorded differently (sampling.seed); record all shards" in merge_error([*shards[:5], other_shard], path)
    rest_positions = np.load(shards[3] / "rest_positions.npy")
    np.save(shards[3] / "rest_positions.npy", rest_positions + np.float32(1e-6))
    assert "differently (rest_positions); record" in merge_error(shards, path)
    record_limb(tmp_path / "whole", POSE_COUNT)
    assert "is not a shard, but a recording of all poses" in merge_error([*shards[:3], tmp_path / "whole"], path)


def test_an_incomplete_shard_is_refused(shards, tmp_path):
    index = json.loads((shards[2] / INDEX_NAME).read_text())
    (shards[2] / INDEX_NAME).write_text(json.dumps({**index, "complete": 1}))
    assert f"'{shards[2]}' is incomplete: 1 of 2 poses" in merge_error(shards, tmp_path / "merged")


def test_a_shard_is_refused_as_a_recording(shards):
    with pytest.raises(RecordingError, match=r"is a shard of a recording \(poses 2 to 3 of 12\); give all shards"):
        read_recording(shards[2])
    with pytest.raises(RecordingError, match=r"\(influences for 12 poses, and none of these\)"):
        read_recording(shards[0])


@pytest.mark.parametrize("shard", [{"first": 11, "of": 12}, {"first": -1, "of": 12}, {"first": "0", "of": 12}, {}, 5])
def test_an_inconsistent_shard_in_the_index_is_refused(shards, shard):
    index = json.loads((shards[2] / INDEX_NAME).read_text())
    (shards[2] / INDEX_NAME).write_text(json.dumps({**index, "shard": shard}))
    with pytest.raises(RecordingError, match="is damaged"):
        read_index(shards[2])


def test_a_non_finite_value_is_refused(shards, tmp_path):
    residuals = np.load(shards[3] / "residuals.npy", mmap_mode="r+")
    residuals[1, 3] = np.nan
    residuals.flush()
    with pytest.raises(RecordingError, match=r"Pose 5 of the rig evaluates to values that are not numbers"):
        list(merge_recordings(shards, tmp_path / "merged"))


def test_several_meshes_are_merged_by_name(shards, tmp_path):
    for number, shard in enumerate(shards):
        for name in ("body", "sleeve"):
            (tmp_path / f"both{number}").mkdir(exist_ok=True)
            shard.rename(tmp_path / f"both{number}" / name) if name == "body" else record_shard(
                tmp_path / f"both{number}" / name, shard_poses(number, SHARD_COUNT, POSE_COUNT) if number else range(0)
            )
    record_limb(tmp_path / "whole", POSE_COUNT)
    shard_folders = [tmp_path / f"both{number}" for number in range(len(shards))]
    stages = {step.stage for step in merge_recordings(shard_folders, tmp_path / "merged")}
    assert stages == {"merge of 'body'", "merge of 'sleeve'"}
    for name in ("body", "sleeve"):
        assert file_bytes(tmp_path / "merged" / name) == file_bytes(tmp_path / "whole")
    single_mesh_shard = record_shard(tmp_path / "alone", range(2))
    assert "of 'body', 'sleeve' and" in merge_error([*shard_folders, single_mesh_shard], tmp_path / "no").replace(
        str(tmp_path), ""
    )


def test_a_full_disk_is_reported_before_anything_is_written(shards, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 100}))
    with pytest.raises(OutputError, match="it takes less than 1 MB and the disk has less than 1 MB left"):
        list(merge_recordings(shards, tmp_path / "merged"))
    assert not (tmp_path / "merged").exists()


PRINT_MERGE_MEMORY = """
import resource, sys
from pathlib import Path
from fdda_addon.core.recording.merge import merge_recordings
bytes_before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for _ in merge_recordings([Path(p) for p in sys.argv[2:]], Path(sys.argv[1])):
    pass
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - bytes_before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Other systems than Linux count peak memory in other units.")
def test_the_memory_of_a_merge_is_bounded(tmp_path):
    """Merging two shards of 60 MB each needs less memory than three chunks that are copied."""
    rig, total = make_rig(), 160_000
    poses, residuals = random_poses(2000), random_residuals(2000)
    for number in (1, 2):
        pose_range = shard_poses(number, 2, total)
        info = replace(recording_info(total), poses=len(pose_range), shard=Shard(pose_range.start, total))
        with RecordingWriter(tmp_path / str(number), rig, partitions_of(rig), info) as shard:
            while shard.complete < len(pose_range):
                shard.append(poses, residuals)
    command = [sys.executable, "-c", PRINT_MERGE_MEMORY, tmp_path / "merged", tmp_path / "1", tmp_path / "2"]
    result = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2])
    assert read_index(tmp_path / "merged")["complete"] == total
    assert int(result.stdout) * 1024 < 3 * merge.COPY_CHUNK_BYTES
