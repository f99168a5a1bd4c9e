# SPDX-License-Identifier: GPL-3.0-or-later
"""Without --overwrite, no verb overwrites a file that it reads, or a file of another kind."""

import json
import os
import shutil
from pathlib import Path

import pytest

from fdda_addon.core.recording.reader import read_recording

from ..conftest import run
from ..refusals import Refusal, file_contents

pytestmark = pytest.mark.one_blender_version

IS_READ = "it is read for this; give another name, or --overwrite."
IS_OTHER = "another file is there, which is not {}; give another name, or --overwrite."


@pytest.fixture
def place(elbow_files, tmp_path):
    """A folder with the elbow's rig, recording and model, and a note of the user's."""
    shutil.copy(elbow_files.rig, tmp_path / "rig.blend")
    shutil.copy(elbow_files.model, tmp_path / "m.onnx")
    shutil.copytree(elbow_files.recording, tmp_path / "recording")
    (tmp_path / "notes.txt").write_text("months of work\n")
    os.link(tmp_path / "m.onnx", tmp_path / "hard.onnx")
    return tmp_path


RECORDING = "recording/recording.json"
VERBS = {
    "build-arm over a note": ("build-arm notes.txt", "notes.txt", "a .blend file"),
    "check-recording over its index": (
        f"check-recording recording --json {RECORDING}",
        RECORDING,
        "the JSON of a check",
    ),
    "train over a note": ("train recording notes.txt --passes 1", "notes.txt", "a model"),
    "train over its recording": ("train recording recording/positions.npy", "recording/positions.npy", "a model"),
    "refining over the rig": (
        "train recording rig.blend --goal-mm 1 --refine rig.blend --passes 1",
        "rig.blend",
        "a model",
    ),
    "bind over its model": ("bind rig.blend m.onnx m.onnx", "m.onnx", ""),
    "bind over a second name of its model": ("bind rig.blend m.onnx hard.onnx", "hard.onnx", ""),
    "bind over a note": ("bind rig.blend m.onnx notes.txt", "notes.txt", "a .blend file"),
    "evaluate over its rig": ("evaluate rig.blend m.onnx --json rig.blend", "rig.blend", ""),
    "evaluate over an index": (f"evaluate rig.blend m.onnx --json {RECORDING}", RECORDING, "the JSON of an evaluation"),
    "a heat map over the rig": ("evaluate rig.blend m.onnx --json e.json --heatmap rig.blend", "rig.blend", ""),
    "benchmark over its model": ("benchmark rig.blend m.onnx --json m.onnx", "m.onnx", ""),
    "bake over its rig": ("bake rig.blend m.onnx rig.blend", "rig.blend", ""),
}


@pytest.mark.parametrize(("line", "path", "kind"), VERBS.values(), ids=VERBS)
def test_a_verb_refuses_to_overwrite_an_input_or_another_kind_of_file(place, capfd, monkeypatch, line, path, kind):
    monkeypatch.chdir(place)
    words = IS_OTHER.format(kind) if kind else IS_READ
    assert Refusal(place, capfd)(*line.split()) == f"Cannot write '{Path(path)}': {words}"


def test_the_alembic_file_beside_a_baked_file_is_checked_too(place, capfd, monkeypatch):
    monkeypatch.chdir(place)
    (place / "out.abc").write_text("mine")
    text = Refusal(place, capfd)("bake", "rig.blend", "m.onnx", "out.blend")
    assert text == f"Cannot write 'out.abc': {IS_OTHER.format('an Alembic file')}"


def test_report_and_checkpoint_are_checked_too(place, capfd, monkeypatch):
    monkeypatch.chdir(place)
    for name, kind in (
        ("report.json", "a training report"),
        ("report.html", "the page of a training report"),
        ("new.checkpoint.npz", "the checkpoint of a training"),
    ):
        (place / name).write_text('{"mine": 1}')
        text = Refusal(place, capfd)("train", "recording", "new.onnx", "--passes", "1")
        assert text == f"Cannot write '{name}': {IS_OTHER.format(kind)}"
        (place / name).unlink()


def test_a_bound_file_does_not_take_the_name_of_the_copied_model(place, capfd, monkeypatch):
    monkeypatch.chdir(place)
    (place / "there").mkdir()
    out = Path("there", "m.onnx")
    text = Refusal(place, capfd)("bind", "rig.blend", "m.onnx", out)
    assert text == f"Cannot write '{out}': the copy of the model beside it has that name; give another name."


def test_a_damaged_recording_is_replaced_only_with_overwrite(place, capfd, monkeypatch):
    """A new recording and `--resume` refuse it, and their messages name `--overwrite`."""
    monkeypatch.chdir(place)
    index = place / "recording" / "recording.json"
    index.write_bytes(index.read_bytes()[:200])
    refusal = Refusal(place, capfd)
    record = ("record", "rig.blend", "recording", "--poses", "10")
    assert "replace it with --overwrite, or" in refusal(*record)
    assert "; record again with --overwrite." in refusal(*record, "--resume")
    assert "; record again with --overwrite." in refusal("train", "recording", "new.onnx")
    assert run(*record, "--overwrite") == 0
    info = read_recording(place / "recording").info
    assert info.complete - len(info.alone_poses) == 10


def done(line: str) -> bool:
    return run(*line.split()) == 0


def test_verbs_overwrite_what_they_wrote_before(place, monkeypatch):
    monkeypatch.chdir(place)
    verbs = (
        "check-recording recording --json w.json",
        "train recording new.onnx --passes 1",
        "bind rig.blend m.onnx bound.blend",
        "evaluate rig.blend m.onnx --json e.json --poses 2 --heatmap e.png",
        "benchmark rig.blend m.onnx --json b.json --frames 2",
        "bake rig.blend m.onnx baked.blend --frames 1 2",
        "bake rig.blend m.onnx baked.usd --frames 1 2",
    )
    for verb in (*verbs, *verbs):
        assert done(verb), verb
    left = [name for name in file_contents(place) if "/" not in name and name.startswith(".")]
    assert left == []


def test_verbs_overwrite_files_of_another_kind_with_overwrite(place, monkeypatch):
    monkeypatch.chdir(place)
    assert done("evaluate rig.blend m.onnx --json notes.txt --poses 2 --overwrite")
    assert json.loads((place / "notes.txt").read_text())["unit"] == "mm"
    (place / "mine.onnx").write_text("a note")
    assert done("train recording mine.onnx --passes 1 --overwrite")
    assert (place / "mine.onnx").stat().st_size > 1000
    before = (place / "rig.blend").read_bytes()
    assert done("bind rig.blend m.onnx rig.blend --overwrite")
    assert (place / "rig.blend").read_bytes() != before
