# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of damaged and malicious files of a farm: their tasks count as not done, and no command ends in a traceback."""

import json
import os
from pathlib import Path

import pytest

from farm.__main__ import main
from farm.fingerprints import (
    InputFingerprints,
    ManifestError,
    TaskManifest,
    digest_file,
    is_up_to_date,
    outdated_tasks,
    read_manifest,
    write_manifest,
)
from farm.run import read_p999_mm
from farm.tasks import make_tasks

from .conftest import ONE_CHARACTER

MANIFEST = {
    **{"format": "fdda-farm-task", "version": 1, "key": "k", "outputs": {}, "skipped": ""},
    **{"seconds": 1.0, "peak_mb": 2.0, "host": "here", "notes": {}},
}
HUGE = int("9" * 400)
JUNK = [b"", b"junk", b"\xff\xfe{}", b"[" * 100_000, b"[]", b"3", b'{"format": NaN}', b'{"a": 1e999}', b"9" * 5000]
VALUES = [None, True, "x", [], {"a": "b"}, HUGE, -1, [[1]], {"mean": "x"}, {"mean": HUGE}, [3], [{"text": 3}]]


def create(path: Path, content: bytes | None) -> None:
    """Create a file with this content; a folder for None, a named pipe for b"pipe"."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if content is None:
        path.mkdir()
    elif content == b"pipe":
        os.mkfifo(path)
    else:
        path.write_bytes(content)


@pytest.mark.parametrize("content", [*JUNK, None, b"pipe"])
def test_a_task_with_a_damaged_manifest_is_not_done(write_plan, capsys, content):
    plan = write_plan()
    task = make_tasks(plan)["elbow/bind"]
    create(task.manifest, content)
    assert read_manifest(task) is None
    for option in ("--list", "--dry-run", "--report-only"):
        assert main([str(plan.path), option]) == 0
    assert "elbow/bind: to do" in capsys.readouterr().out


def test_commands_accept_manifests_with_any_values(write_plan, capsys):
    """Each manifest is either refused, or all commands can use its values."""
    plan = write_plan()
    tasks = make_tasks(plan)
    for key in MANIFEST:
        for value in (
            *VALUES,
            {"a": [1]},
            {"a": [1, 2, 3]},
            {"a": [HUGE, "b"]},
            {"bound": 3},
            {"bound": {"elbow.onnx": 3}},
        ):
            for task in tasks.values():
                create(task.manifest, json.dumps(MANIFEST | {key: value}).encode())
            for option in ("--list", "--dry-run", "--report-only"):
                assert main([str(plan.path), option]) == 0, (key, value)
    assert capsys.readouterr().err == ""


@pytest.fixture
def finished_farm(write_plan):
    """Return a plan, its tasks and their fingerprints; all tasks are done according to their manifests."""
    plan = write_plan(ONE_CHARACTER + "goal_mm = 1.0\nrounds = 1\n")
    tasks = make_tasks(plan)
    fingerprints = InputFingerprints(plan.farm, tasks)
    for name, task in tasks.items():
        for output in task.outputs:
            create(task.folder / output, f"{name} left {output}".encode())
        outputs = {output: digest_file(task.folder / output) for output in task.outputs}
        for output, destination in task.publishes:
            create(destination, (task.folder / output).read_bytes())
        write_manifest(task, TaskManifest(fingerprints.of_task(name), outputs))
    assert outdated_tasks(tasks, fingerprints) == ([], {})
    return plan, tasks, fingerprints


def test_a_task_with_a_changed_or_missing_output_is_not_up_to_date(finished_farm):
    _, tasks, fingerprints = finished_farm
    task, key = tasks["elbow/bind"], fingerprints.of_task("elbow/bind")
    for path in [destination for _, destination in task.publishes] + [task.folder / name for name in task.outputs]:
        content = path.read_bytes()
        for junk in (b"x" * len(content), b"", None):
            path.unlink()
            if junk is not None:
                path.write_bytes(junk)
            assert not is_up_to_date(task, key), (path, junk)
        path.write_bytes(content)
        assert is_up_to_date(task, key)
    record = tasks["elbow/record-1"]
    (record.folder / "recording").write_bytes(b"x" * len("elbow/record-1 left recording"))
    task.manifest.unlink()
    for dependency in task.after:
        tasks[dependency].manifest.unlink()
    assert "elbow/record-1" not in outdated_tasks(tasks, fingerprints)[0], (
        "merge is done and does not read the recording again"
    )
    tasks["elbow/merge"].manifest.unlink()
    assert "elbow/record-1" in outdated_tasks(tasks, fingerprints)[0], (
        "merge reads the recording, so it must be made again"
    )


@pytest.mark.parametrize("content", [*JUNK, None, b"pipe"])
def test_damaged_evaluations_and_reports_are_refused(finished_farm, content):
    plan, tasks, _ = finished_farm
    for name in ("evaluation.json", "report.json"):
        path = tasks["elbow/bind"].folder / name
        path.unlink()
        create(path, content)
    assert main([str(plan.path), "--report-only"]) == 0
    assert json.loads(plan.path.with_name("report.json").read_text())["characters"]["elbow"]["state"] == "done"
    evaluate = tasks["elbow/evaluate-0"]
    (evaluate.folder / "evaluation.json").unlink()
    create(evaluate.folder / "evaluation.json", content)
    with pytest.raises(ManifestError, match=r"evaluation\.json' is damaged \(.*\); run the farm again to restore it"):
        read_p999_mm(evaluate)
    assert read_manifest(evaluate) is None


def test_evaluations_and_reports_with_wrong_values_are_refused(finished_farm):
    plan, tasks, _ = finished_farm
    folder = tasks["elbow/bind"].folder
    for value in VALUES:
        (folder / "evaluation.json").write_text(json.dumps({"vertices": value, "fdda": value, "linear": value}))
        (folder / "report.json").write_text(json.dumps({"goal": value, "warnings": value}))
        assert main([str(plan.path), "--report-only"]) == 0, value
        evaluate = tasks["elbow/evaluate-0"]
        for evaluation in ({"fdda": value}, {"fdda": {"p999": value}} if value != -1 else {}, value):
            (evaluate.folder / "evaluation.json").write_text(json.dumps(evaluation))
            with pytest.raises(ManifestError):
                read_p999_mm(evaluate)


def test_invalid_values_of_the_last_report_are_ignored(finished_farm):
    plan, _, _ = finished_farm
    plan.path.write_text(
        plan.path.read_text() + ONE_CHARACTER.replace("elbow]", "other]").replace("out/elbow", "out/other")
    )
    assert main([str(plan.path), "--report-only"]) == 0
    path = plan.path.with_name("report.json")
    valid_report = json.loads(path.read_text())
    character = valid_report["characters"]["elbow"]
    assert character["models"] and character["failures"] == []
    for key in character:
        for value in VALUES:
            characters = {name: character | {key: value} for name in ("elbow", "other")}
            path.write_text(json.dumps(valid_report | {"characters": characters}))
            # The new report takes the entry of the other character from the last report.
            assert main([str(plan.path), "--report-only", "--only", "elbow"]) == 0, (key, value)
    for content in (*JUNK, b'{"characters": 3}'):
        path.write_bytes(content)
        status = main([str(plan.path), "--report-only"])
        assert status == (1 if content else 0), "the farm does not replace a file of another kind"
        path.write_text(json.dumps(valid_report))
