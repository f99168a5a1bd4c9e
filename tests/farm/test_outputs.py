# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests that the farm overwrites no inputs, no files of another kind, no edited files, and no folders of others."""

import pytest

from farm.__main__ import main
from farm.fingerprints import TaskManifest, digest_file, write_manifest
from farm.outputs import check_published
from farm.run import FAILED, run_task
from farm.tasks import make_tasks
from fdda_addon.core.errors import OutputError

from .conftest import ONE_CHARACTER, read_all_files

OUTPUT_BESIDE_PLAN = '[characters.elbow]\nrig = "elbow.blend"\noutput = "."\n'
OTHER_CHARACTER = '[characters.other]\nrig = "elbow.blend"\noutput = "out"\n'
USER_FILES = {
    "notes.html": b"<!doctype html><title>Notes</title>",
    "notes.json": b'{"name": "mine"}',
    "out/elbow.onnx": b"mine",
}
READ_MESSAGE = "the farm reads it"


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        (OUTPUT_BESIDE_PLAN, ["--report", "all.html"], f"elbow.blend': {READ_MESSAGE}"),
        (OUTPUT_BESIDE_PLAN, ["--task", "elbow/bind"], f"elbow.blend': {READ_MESSAGE}"),
        (OUTPUT_BESIDE_PLAN, ["--overwrite", "--report", "all.html"], f"elbow.blend': {READ_MESSAGE}"),
        (
            OTHER_CHARACTER + OUTPUT_BESIDE_PLAN.replace('"elbow.blend"', '"notes.json"'),
            ["--report", "all.html"],
            f"elbow.blend': {READ_MESSAGE}",
        ),
        (
            ONE_CHARACTER + 'depends = ["out/elbow/elbow.blend"]\n',
            ["--task", "elbow/bind"],
            f"elbow.blend': {READ_MESSAGE}",
        ),
        (OUTPUT_BESIDE_PLAN.replace("elbow]", "hero]"), [], "report.json': two files would have this name"),
        (ONE_CHARACTER.replace("out/elbow", "out"), [], "elbow.onnx': another file is there, which is not a model"),
        (ONE_CHARACTER.replace("out/elbow", "notes.json"), [], "notes.json' is a file"),
        (ONE_CHARACTER.replace('"elbow.blend"', '"farm/elbow/bind/rig.blend"'), [], "lies where the farm keeps"),
        (ONE_CHARACTER.replace("out/elbow", "farm/elbow/bind"), [], "lies where the farm keeps"),
        (
            ONE_CHARACTER + OTHER_CHARACTER.replace('"out"', '"out/../out/elbow"'),
            [],
            "give each character an output of its own",
        ),
        (ONE_CHARACTER, ["--report", "elbow.blend"], f"elbow.blend': {READ_MESSAGE}"),
        (ONE_CHARACTER, ["--report", "characters.toml", "--report-only"], f"characters.toml': {READ_MESSAGE}"),
        (ONE_CHARACTER, ["--report", "notes.html"], "notes.html': another file is there, which is not the page"),
        (ONE_CHARACTER, ["--openjd", "characters.toml"], f"characters.toml': {READ_MESSAGE}"),
        (
            ONE_CHARACTER,
            ["--openjd", "notes.json"],
            "notes.json': another file is there, which is not an OpenJD job template",
        ),
        (ONE_CHARACTER, ["--flamenco", "elbow.blend"], f"elbow.blend': {READ_MESSAGE}"),
        (
            ONE_CHARACTER,
            ["--flamenco", "notes.json"],
            "notes.json': another file is there, which is not a job for Flamenco",
        ),
    ],
)
def test_existing_files_are_not_overwritten(write_plan, tmp_path, monkeypatch, capsys, text, arguments, message):
    monkeypatch.chdir(tmp_path)
    plan = write_plan(text)
    for name, content in USER_FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    if "depends" in text:
        (tmp_path / "out/elbow").mkdir()
        (tmp_path / "out/elbow/elbow.blend").write_bytes(b"BLENDER of others")
    old_files = read_all_files(tmp_path)
    assert main([str(plan.path), *arguments]) == 1
    assert message in capsys.readouterr().err
    assert read_all_files(tmp_path) == old_files, "the farm must refuse before it writes anything"


def test_files_that_the_farm_wrote_are_replaced(write_plan, tmp_path, capsys):
    plan = write_plan()
    for option in ("--openjd", "--flamenco", "--report"):
        arguments = [
            str(plan.path),
            option,
            str(tmp_path / f"{option}.html"),
            *["--report-only"] * (option == "--report"),
        ]
        assert [main(arguments), main(arguments)] == [0, 0], capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("influences/notes.txt", "The farm did not make"),
        ("influences.json", "which is not the fingerprint of a task"),
        ("influences.log", "which is not the log of a task"),
    ],
)
def test_files_of_the_user_in_the_work_folder_are_kept(write_plan, tmp_path, name, message):
    plan = write_plan()
    user_file = tmp_path / "farm/elbow" / name
    user_file.parent.mkdir(parents=True)
    user_file.write_text("mine")
    outcome = run_task(plan.farm, make_tasks(plan), "elbow/influences")
    assert outcome.state == FAILED and message in outcome.sentence, outcome
    assert user_file.read_text() == "mine"


def test_an_edited_bound_file_is_kept(write_plan):
    task = make_tasks(write_plan())["elbow/bind"]
    content_by_suffix = {".blend": b"BLENDER", ".onnx": b"\x08\x08\x12", "json": b"", "html": b""}
    for name, path in task.publishes:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(next(content for suffix, content in content_by_suffix.items() if name.endswith(suffix)))
    task.folder.mkdir(parents=True)
    write_manifest(task, TaskManifest("key", {name: digest_file(path) for name, path in task.publishes}))
    check_published(task)
    bound_file = next(path for _, path in task.publishes if path.suffix == ".blend")
    bound_file.write_bytes(b"BLENDER with animation")
    with pytest.raises(OutputError, match=r"elbow\.blend': it was edited since the farm wrote it; move it, or"):
        check_published(task)
    check_published(task, overwrite=True)
    bound_file.write_bytes(b"")
    check_published(task)
