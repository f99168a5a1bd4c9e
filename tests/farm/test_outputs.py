# SPDX-License-Identifier: GPL-3.0-or-later
"""What a farm does not write over: what it reads, files of another kind, what others have changed or put there."""

import pytest

from farm.__main__ import main
from farm.fingerprints import TaskManifest, digest_file, write_manifest
from farm.outputs import check_published
from farm.run import FAILED, run_task
from farm.tasks import make_tasks
from fdda_addon.core.errors import OutputError

from .conftest import ONE, contents

HERE = '[characters.elbow]\nrig = "elbow.blend"\noutput = "."\n'
OTHER = '[characters.other]\nrig = "elbow.blend"\noutput = "out"\n'
KEPT = {
    "notes.html": b"<!doctype html><title>Notes</title>",
    "notes.json": b'{"name": "mine"}',
    "out/elbow.onnx": b"mine",
}
READ = "the farm reads it"


@pytest.mark.parametrize(
    ("text", "arguments", "words"),
    [
        (HERE, ["--report", "all.html"], f"elbow.blend': {READ}"),
        (HERE, ["--task", "elbow/bind"], f"elbow.blend': {READ}"),
        (HERE, ["--overwrite", "--report", "all.html"], f"elbow.blend': {READ}"),
        (OTHER + HERE.replace('"elbow.blend"', '"notes.json"'), ["--report", "all.html"], f"elbow.blend': {READ}"),
        (ONE + 'depends = ["out/elbow/elbow.blend"]\n', ["--task", "elbow/bind"], f"elbow.blend': {READ}"),
        (HERE.replace("elbow]", "hero]"), [], "report.json': two files would have this name"),
        (ONE.replace("out/elbow", "out"), [], "elbow.onnx': another file is there, which is not a model"),
        (ONE.replace("out/elbow", "notes.json"), [], "notes.json' is a file"),
        (ONE.replace('"elbow.blend"', '"farm/elbow/bind/rig.blend"'), [], "lies where the farm keeps"),
        (ONE.replace("out/elbow", "farm/elbow/bind"), [], "lies where the farm keeps"),
        (ONE + OTHER.replace('"out"', '"out/../out/elbow"'), [], "give each character an output of its own"),
        (ONE, ["--report", "elbow.blend"], f"elbow.blend': {READ}"),
        (ONE, ["--report", "characters.toml", "--report-only"], f"characters.toml': {READ}"),
        (ONE, ["--report", "notes.html"], "notes.html': another file is there, which is not the page"),
        (ONE, ["--openjd", "characters.toml"], f"characters.toml': {READ}"),
        (ONE, ["--openjd", "notes.json"], "notes.json': another file is there, which is not an OpenJD job template"),
        (ONE, ["--flamenco", "elbow.blend"], f"elbow.blend': {READ}"),
        (ONE, ["--flamenco", "notes.json"], "notes.json': another file is there, which is not a job for Flamenco"),
    ],
)
def test_what_is_there_is_not_written_over(written, tmp_path, monkeypatch, capsys, text, arguments, words):
    monkeypatch.chdir(tmp_path)
    plan = written(text)
    for name, content in KEPT.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    if "depends" in text:
        (tmp_path / "out/elbow").mkdir()
        (tmp_path / "out/elbow/elbow.blend").write_bytes(b"BLENDER of others")
    before = contents(tmp_path)
    assert main([str(plan.path), *arguments]) == 1
    assert words in capsys.readouterr().err
    assert contents(tmp_path) == before, "and nothing was begun"


def test_what_was_written_before_is_written_again(written, tmp_path, capsys):
    plan = written()
    for option in ("--openjd", "--flamenco", "--report"):
        arguments = [
            str(plan.path),
            option,
            str(tmp_path / f"{option}.html"),
            *["--report-only"] * (option == "--report"),
        ]
        assert [main(arguments), main(arguments)] == [0, 0], capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("influences/notes.txt", "influences' is there, and not from the farm"),
        ("influences.json", "which is not the fingerprint of a task"),
        ("influences.log", "which is not the log of a task"),
    ],
)
def test_what_is_not_the_farm_s_stays_in_its_folder(written, tmp_path, name, words):
    plan = written()
    mine = tmp_path / "farm/elbow" / name
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    outcome = run_task(plan.farm, make_tasks(plan), "elbow/influences")
    assert outcome.state == FAILED and words in outcome.sentence, outcome
    assert mine.read_text() == "mine"


def test_a_bound_file_that_somebody_has_changed_stays(written):
    task = make_tasks(written())["elbow/bind"]
    contents_of = {".blend": b"BLENDER", ".onnx": b"\x08\x08\x12", "json": b"", "html": b""}
    for name, place in task.publishes:
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(next(content for end, content in contents_of.items() if name.endswith(end)))
    task.folder.mkdir(parents=True)
    write_manifest(task, TaskManifest("key", {name: digest_file(place) for name, place in task.publishes}))
    check_published(task)
    bound = next(place for _, place in task.publishes if place.suffix == ".blend")
    bound.write_bytes(b"BLENDER with animation")
    with pytest.raises(
        OutputError, match=r"elbow\.blend': somebody has changed it since the farm made it; move it, or"
    ):
        check_published(task)
    check_published(task, overwrite=True)
    bound.write_bytes(b"")
    check_published(task)
