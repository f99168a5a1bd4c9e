# SPDX-License-Identifier: GPL-3.0-or-later
"""Merged shards equal the recording of one run bit for bit, for every kind of pose."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bpy
import pytest

from blend_fixtures.characters.controls import free_shape_keys
from blend_fixtures.characters.meshes import body_and_sleeve
from fdda_addon.core.errors import RecordingError
from fdda_addon.core.recording.merge import merge_recordings
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.recording import run as recording_run
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record, record_meshes
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.scene_rig import SceneRig, find_rig, find_rigs

from .conftest import run
from .figure import WAVE, add_wave, build_figure
from .refusals import Refusal, file_contents

pytestmark = pytest.mark.one_blender_version

FIST = 'armature_object/pose.bones["arm.R"]["fist"]=0:1'


def drain(steps) -> None:
    for _ in steps:
        pass


def saved(build: Callable[[], object], path: Path) -> Path:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build()
    save_copy(path)
    return path


def waving() -> None:
    add_wave(build_figure())


def opened(rig: Path) -> SceneRig:
    """Open the file and return its rig, as a separate process would."""
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    return find_rig()


CASES = {
    "random poses, an action and its mirror image, a custom property": (
        waving,
        RecordingSettings(poses=20, actions=(WAVE,), mirror=True, controls=(FIST,), influence_poses=2),
    ),
    "an action alone": (waving, RecordingSettings(poses=0, actions=(WAVE,), influence_poses=2)),
    "shape keys": (free_shape_keys, RecordingSettings(poses=23, controls=("shape_keys",), influence_poses=2)),
    "fitted weights": (waving, RecordingSettings(poses=30, influence_poses=2, fit_linear="hard")),
}


@pytest.mark.parametrize("count", [pytest.param(1, marks=pytest.mark.slow), 3])
@pytest.mark.parametrize("case", CASES)
def test_shards_are_the_recording_of_one_run(tmp_path, case, count):
    build, settings = CASES[case]
    rig = saved(build, tmp_path / "rig.blend")
    drain(record(opened(rig), tmp_path / "whole", settings))
    found = tmp_path / "found"
    drain(record(opened(rig), found, replace(settings, detect_influences=True)))
    shards = [tmp_path / f"shard{number}" for number in range(1, count + 1)]
    # Record the last shard first: the result must not depend on what was recorded before.
    for number in range(count, 0, -1):
        own = replace(settings, shard=(number, count), influences=found)
        drain(record(opened(rig), shards[number - 1], own))
    drain(merge_recordings(shards, tmp_path / "merged"))
    assert file_contents(tmp_path / "merged") == file_contents(tmp_path / "whole")
    assert len(read_recording(tmp_path / "merged").pose_matrices) >= settings.poses


def test_shards_that_find_the_influences_themselves_are_the_same(tmp_path):
    rig = saved(waving, tmp_path / "rig.blend")
    settings = RecordingSettings(poses=9, influence_poses=2)
    drain(record(opened(rig), tmp_path / "whole", settings))
    shards = [tmp_path / "1", tmp_path / "2"]
    for number, shard in enumerate(shards, 1):
        drain(record(opened(rig), shard, replace(settings, shard=(number, 2))))
    drain(merge_recordings(shards, tmp_path / "merged"))
    assert file_contents(tmp_path / "merged") == file_contents(tmp_path / "whole")


@pytest.mark.parametrize("alone", [False, True])
def test_shards_of_several_meshes(tmp_path, alone):
    """The meshes are recorded in one pass, or in two if one mesh reads the subdivided other mesh."""

    def build() -> None:
        body_and_sleeve()
        if alone:
            bpy.data.objects["elbow"].modifiers.new("Subdivision", "SUBSURF").levels = 1

    rig = saved(build, tmp_path / "rig.blend")

    def recorded(folder: str, settings: RecordingSettings) -> Path:
        bpy.ops.wm.open_mainfile(filepath=str(rig))
        drain(record_meshes([(r, tmp_path / folder / r.mesh_object.name) for r in find_rigs()], settings))
        return tmp_path / folder

    settings = RecordingSettings(poses=10, actions=("elbow_wave",), influence_poses=2)
    whole = recorded("whole", settings)
    found = recorded("found", replace(settings, detect_influences=True))
    own = replace(settings, influences=found)
    shards = [recorded(str(number), replace(own, shard=(number, 4))) for number in range(1, 5)]
    drain(merge_recordings(shards, tmp_path / "merged"))
    assert len(file_contents(whole)) > 10 and file_contents(tmp_path / "merged") == file_contents(whole)


@pytest.mark.parametrize("shard", [None, (2, 3)])
def test_a_resumed_shard_repeats_no_work(tmp_path, monkeypatch, shard):
    rig = saved(waving, tmp_path / "rig.blend")
    settings = RecordingSettings(poses=24, actions=(WAVE,), influence_poses=2, shard=shard)
    drain(record(opened(rig), tmp_path / "whole", settings))
    steps = record(opened(rig), tmp_path / "part", settings)
    while (step := next(steps)).stage != "poses" or step.done < 7:
        pass
    steps.close()

    def again(*_: object) -> None:
        raise AssertionError("the influences are known")

    monkeypatch.setattr(recording_run, "detect_influences", again)
    resumed = replace(settings, resume=True)
    done = [step.done for step in record(opened(rig), tmp_path / "part", resumed)]
    assert done[0] >= 7 and done == list(range(done[0], done[-1] + 1))
    assert file_contents(tmp_path / "part") == file_contents(tmp_path / "whole")
    assert [step.done for step in record(opened(rig), tmp_path / "part", resumed)] == done[-1:]
    assert file_contents(tmp_path / "part") == file_contents(tmp_path / "whole")


def test_record_and_merge_recordings_use_shards(elbow_files, tmp_path, capfd):
    options = ("--poses", 10, "--action", "elbow_wave")
    assert run("record", elbow_files.rig, tmp_path / "whole", *options) == 0
    for _ in range(2):
        assert run("record", elbow_files.rig, tmp_path / "found", *options, "--detect-influences", "--resume") == 0
    for number in (1, 2):
        own = ("--shard", f"{number}/2", "--influences", tmp_path / "found", "--resume")
        assert run("record", elbow_files.rig, tmp_path / f"s{number}", *options, *own) == 0
        assert run("record", elbow_files.rig, tmp_path / f"s{number}", *options, *own) == 0
    assert run("merge-recordings", tmp_path / "s1", tmp_path / "s2", tmp_path / "merged") == 0
    out = capfd.readouterr().out
    assert f"{tmp_path / 'found'}: influences in" in out and f"{tmp_path / 's2'}: 20 poses in" in out
    assert f"{tmp_path / 'merged'}: 40 poses of 2 shards in" in out
    assert file_contents(tmp_path / "merged") == file_contents(tmp_path / "whole")


def test_invalid_options_of_shards_are_refused(elbow_files, tmp_path, capfd):
    for shard in ("0/2", "3/2", "1", "a/b", "1/2/3", "-1/2", "1/100001"):
        assert run("record", elbow_files.rig, tmp_path / "r", f"--shard={shard}") == 2
        assert "a shard is K/N, part K of N" in capfd.readouterr().err
    assert run("record", elbow_files.rig, tmp_path / "r", "--detect-influences", "--shard", "1/2") == 2
    assert "leave --shard and --influences out" in capfd.readouterr().err


def test_influences_of_another_rig_are_refused(elbow_files, tmp_path, capfd):
    refusal = Refusal(tmp_path, capfd)
    found = tmp_path / "found"
    assert run("record", elbow_files.rig, found, "--poses", 10, "--detect-influences") == 0
    of_shard = ("record", elbow_files.rig, tmp_path / "s", "--shard", "1/2", "--influences")
    text = refusal(*of_shard, found, "--poses", 11)
    assert "not those of this recording: they were found with other settings (sources, poses)." in text
    assert "with other settings (seed)" in refusal(*of_shard, found, "--poses", 10, "--seed", 1)
    assert "'none' is not a recording" in refusal(*of_shard, tmp_path / "none").replace(f"{tmp_path}{os.sep}", "")
    other = saved(waving, tmp_path / "other.blend")
    text = refusal("record", other, tmp_path / "s", "--shard", "1/2", "--influences", found, "--poses", 10)
    assert "are of other partitions than those of 'body'; find them with the same rig and options" in text


def test_a_shard_of_another_rig_is_not_resumed(elbow_files, tmp_path):
    settings = RecordingSettings(poses=6, influence_poses=1, shard=(1, 2))
    drain(record(opened(elbow_files.rig), tmp_path / "s", settings))
    other = opened(saved(waving, tmp_path / "other.blend"))
    with pytest.raises(RecordingError, match=r"Cannot resume .* it was recorded differently"):
        drain(record(other, tmp_path / "s", replace(settings, resume=True)))
