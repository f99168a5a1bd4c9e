# SPDX-License-Identifier: GPL-3.0-or-later
"""Shards that are joined: bit for bit the recording of one run, whatever their order and whatever interrupts it."""

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

POSES, COUNT = 12, 5


def record_shard(path: Path, poses: range, seed: int = 0) -> Path:
    rig, info = make_rig(), replace(recording_info(POSES, seed), poses=len(poses), shard=Shard(poses.start, POSES))
    with RecordingWriter(path, rig, partitions_of(rig), info) as shard:
        part = slice(poses.start, poses.stop)
        shard.append(random_poses(POSES)[part], random_residuals(POSES)[part])
    return path


@pytest.fixture
def shards(tmp_path: Path) -> list[Path]:
    """All shards, and one without poses."""
    parts = [shard_poses(number, COUNT, POSES) for number in range(1, COUNT + 1)]
    return [record_shard(tmp_path / f"s{number}", part) for number, part in enumerate([range(0), *parts])]


def merged(shards: list[Path], path: Path) -> Path:
    assert [step.done for step in merge_recordings(shards, path)][-1] == POSES
    return path


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(("count", "total"), [(1, 1), (1, 7), (3, 7), (7, 7), (9, 7), (64, 1000)])
def test_each_pose_is_in_one_shard(count, total):
    parts = [shard_poses(number, count, total) for number in range(1, count + 1)]
    assert [pose for part in parts for pose in part] == list(range(total))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("piece", [1, 3 * 4 * (40 * 3 + 4 * 16), 1 << 24])
def test_merged_shards_are_the_recording_of_one_run(shards, tmp_path, monkeypatch, piece):
    monkeypatch.setattr(merge, "COPY_CHUNK_BYTES", piece)
    record_limb(tmp_path / "whole", POSES)
    path = merged([shards[n] for n in (3, 5, 0, 1, 4, 2)], tmp_path / "merged")
    assert contents(path) == contents(tmp_path / "whole")
    read_recording(path)


def test_a_merge_goes_on_and_repeats_nothing(shards, tmp_path, monkeypatch):
    monkeypatch.setattr(merge, "COPY_CHUNK_BYTES", 1)
    path, appended = tmp_path / "merged", []
    append = writer.RecordingWriter.append
    monkeypatch.setattr(
        writer.RecordingWriter, "append", lambda self, *arrays: (appended.append(self.complete), append(self, *arrays))
    )
    steps = merge_recordings(shards, path)
    while next(steps).done < 7:
        pass
    steps.close()
    assert read_index(path)["complete"] == 7
    merged(shards, path)
    before = contents(path)
    merged(shards, path)
    record_limb(tmp_path / "whole", POSES)
    assert appended[:POSES] == list(range(POSES))
    assert contents(path) == before == contents(tmp_path / "whole")


def sentence(shards: list[Path], path: Path) -> str:
    with pytest.raises(RecordingError) as error:
        list(merge_recordings(shards, path))
    assert not path.exists()
    return str(error.value)


def test_what_is_missing_or_twice_is_named(shards, tmp_path):
    path = tmp_path / "merged"
    assert sentence([*shards[:2], *shards[4:]], path) == (
        f"Poses 2 to 6 of {POSES} are in none of the 4 shards; give all of them."
    )
    assert sentence(shards[:5], path).startswith("Poses 9 to 11 of 12 are in none of the 5 shards")
    assert sentence(shards[:1], path).startswith("Poses 0 to 11 of 12 are in none of the 1 shards")
    assert sentence([*shards, shards[2]], path) == (
        f"'{shards[2]}' and '{shards[2]}' have poses in common; give each shard once."
    )
    assert sentence([], path) == "There is nothing to merge; give the folders of the shards."
    assert "'none' is not a recording" in sentence([*shards, tmp_path / "none"], path).replace(
        f"{tmp_path}{os.sep}", ""
    )


def test_shards_of_other_recordings_are_refused(shards, tmp_path):
    path = tmp_path / "merged"
    other = record_shard(tmp_path / "other", range(9, 12), seed=4)
    assert "recorded differently (sampling.seed); record all shards" in sentence([*shards[:5], other], path)
    rest = np.load(shards[3] / "rest_positions.npy")
    np.save(shards[3] / "rest_positions.npy", rest + np.float32(1e-6))
    assert "differently (rest_positions); record" in sentence(shards, path)
    record_limb(tmp_path / "whole", POSES)
    assert "is not a shard, but a complete recording" in sentence([*shards[:3], tmp_path / "whole"], path)


def test_a_shard_that_is_incomplete_is_refused(shards, tmp_path):
    index = json.loads((shards[2] / INDEX_NAME).read_text())
    (shards[2] / INDEX_NAME).write_text(json.dumps({**index, "complete": 1}))
    assert f"'{shards[2]}' is incomplete: 1 of 2 poses" in sentence(shards, tmp_path / "merged")


def test_a_shard_is_no_recording(shards):
    with pytest.raises(RecordingError, match=r"is a shard of a recording \(poses 2 to 3 of 12\); give all shards"):
        read_recording(shards[2])
    with pytest.raises(RecordingError, match=r"\(influences for 12 poses, and none of these\)"):
        read_recording(shards[0])


@pytest.mark.parametrize("shard", [{"first": 11, "of": 12}, {"first": -1, "of": 12}, {"first": "0", "of": 12}, {}, 5])
def test_an_index_that_contradicts_itself_is_damaged(shards, shard):
    index = json.loads((shards[2] / INDEX_NAME).read_text())
    (shards[2] / INDEX_NAME).write_text(json.dumps({**index, "shard": shard}))
    with pytest.raises(RecordingError, match="is damaged"):
        read_index(shards[2])


def test_a_value_that_is_no_number_is_named(shards, tmp_path):
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
                tmp_path / f"both{number}" / name, shard_poses(number, COUNT, POSES) if number else range(0)
            )
    record_limb(tmp_path / "whole", POSES)
    both = [tmp_path / f"both{number}" for number in range(len(shards))]
    stages = {step.stage for step in merge_recordings(both, tmp_path / "merged")}
    assert stages == {"merge of 'body'", "merge of 'sleeve'"}
    for name in ("body", "sleeve"):
        assert contents(tmp_path / "merged" / name) == contents(tmp_path / "whole")
    alone = record_shard(tmp_path / "alone", range(2))
    assert "of 'body', 'sleeve' and" in sentence([*both, alone], tmp_path / "no").replace(str(tmp_path), "")


def test_a_full_disk_is_said_before_anything_is_written(shards, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 100}))
    with pytest.raises(OutputError, match="it takes less than 1 MB and the disk has less than 1 MB left"):
        list(merge_recordings(shards, tmp_path / "merged"))
    assert not (tmp_path / "merged").exists()


MEASURE = """
import resource, sys
from pathlib import Path
from fdda_addon.core.recording.merge import merge_recordings
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for _ in merge_recordings([Path(p) for p in sys.argv[2:]], Path(sys.argv[1])):
    pass
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Other systems than Linux count peak memory in other units.")
def test_memory_stays_bounded(tmp_path):
    """Two shards of 60 MB each take no more than three pieces."""
    rig, total = make_rig(), 160_000
    poses, residuals = random_poses(2000), random_residuals(2000)
    for number in (1, 2):
        own = shard_poses(number, 2, total)
        info = replace(recording_info(total), poses=len(own), shard=Shard(own.start, total))
        with RecordingWriter(tmp_path / str(number), rig, partitions_of(rig), info) as shard:
            while shard.complete < len(own):
                shard.append(poses, residuals)
    command = [sys.executable, "-c", MEASURE, tmp_path / "merged", tmp_path / "1", tmp_path / "2"]
    result = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2])
    assert read_index(tmp_path / "merged")["complete"] == total
    assert int(result.stdout) * 1024 < 3 * merge.COPY_CHUNK_BYTES
