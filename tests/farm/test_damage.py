# SPDX-License-Identifier: GPL-3.0-or-later
"""Damaged and hostile files of a farm: what they were of is not done, and nothing ends in a traceback."""

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

from .conftest import ONE

MANIFEST = {
    **{"format": "fdda-farm-task", "version": 1, "key": "k", "outputs": {}, "skipped": ""},
    **{"seconds": 1.0, "peak_mb": 2.0, "host": "here", "notes": {}},
}
HUGE = int("9" * 400)
JUNK = [b"", b"junk", b"\xff\xfe{}", b"[" * 100_000, b"[]", b"3", b'{"format": NaN}', b'{"a": 1e999}', b"9" * 5000]
VALUES = [None, True, "x", [], {"a": "b"}, HUGE, -1, [[1]], {"mean": "x"}, {"mean": HUGE}, [3], [{"text": 3}]]


def put(path: Path, content: bytes | None) -> None:
    """Put something into the place of a file: a folder for None, a pipe for b"pipe"."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if content is None:
        path.mkdir()
    elif content == b"pipe":
        os.mkfifo(path)
    else:
        path.write_bytes(content)


@pytest.mark.parametrize("content", [*JUNK, None, b"pipe"])
def test_a_damaged_fingerprint_is_of_a_task_that_is_not_done(written, capsys, content):
    plan = written()
    task = make_tasks(plan)["elbow/bind"]
    put(task.manifest, content)
    assert read_manifest(task) is None
    for option in ("--list", "--dry-run", "--report-only"):
        assert main([str(plan.path), option]) == 0
    assert "elbow/bind: to do" in capsys.readouterr().out


def test_fingerprints_of_wrong_values(written, capsys):
    """They are refused, or what they say is of use to all that reads it."""
    plan = written()
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
                put(task.manifest, json.dumps(MANIFEST | {key: value}).encode())
            for option in ("--list", "--dry-run", "--report-only"):
                assert main([str(plan.path), option]) == 0, (key, value)
    assert capsys.readouterr().err == ""


@pytest.fixture
def bound(written):
    """A farm whose tasks are all done, by their fingerprints, and its task `bind`."""
    plan = written(ONE + "goal_mm = 1.0\nrounds = 1\n")
    tasks = make_tasks(plan)
    fingerprints = InputFingerprints(plan.farm, tasks)
    for name, task in tasks.items():
        for output in task.outputs:
            put(task.folder / output, f"{name} left {output}".encode())
        outputs = {output: digest_file(task.folder / output) for output in task.outputs}
        for output, place in task.publishes:
            put(place, (task.folder / output).read_bytes())
        write_manifest(task, TaskManifest(fingerprints.of_task(name), outputs))
    assert outdated_tasks(tasks, fingerprints) == ([], {})
    return plan, tasks, fingerprints


def test_junk_in_an_output_is_not_up_to_date(bound):
    _, tasks, fingerprints = bound
    task, key = tasks["elbow/bind"], fingerprints.of_task("elbow/bind")
    for path in [place for _, place in task.publishes] + [task.folder / name for name in task.outputs]:
        kept = path.read_bytes()
        for junk in (b"x" * len(kept), b"", None):
            path.unlink()
            if junk is not None:
                path.write_bytes(junk)
            assert not is_up_to_date(task, key), (path, junk)
        path.write_bytes(kept)
        assert is_up_to_date(task, key)
    record = tasks["elbow/record-1"]
    (record.folder / "recording").write_bytes(b"x" * len("elbow/record-1 left recording"))
    task.manifest.unlink()
    for before in task.after:
        tasks[before].manifest.unlink()
    assert "elbow/record-1" not in outdated_tasks(tasks, fingerprints)[0], "merge is done, and needs it no more"
    tasks["elbow/merge"].manifest.unlink()
    assert "elbow/record-1" in outdated_tasks(tasks, fingerprints)[0], "and is made again before it is used"


@pytest.mark.parametrize("content", [*JUNK, None, b"pipe"])
def test_damaged_evaluations_and_reports(bound, content):
    plan, tasks, _ = bound
    for name in ("evaluation.json", "report.json"):
        path = tasks["elbow/bind"].folder / name
        path.unlink()
        put(path, content)
    assert main([str(plan.path), "--report-only"]) == 0
    assert json.loads(plan.path.with_name("report.json").read_text())["characters"]["elbow"]["state"] == "done"
    evaluate = tasks["elbow/evaluate-0"]
    (evaluate.folder / "evaluation.json").unlink()
    put(evaluate.folder / "evaluation.json", content)
    with pytest.raises(
        ManifestError, match=r"evaluation\.json' is damaged \(.*\); run the farm again, and it is made again"
    ):
        read_p999_mm(evaluate)
    assert read_manifest(evaluate) is None


def test_evaluations_and_reports_of_wrong_values(bound):
    plan, tasks, _ = bound
    folder = tasks["elbow/bind"].folder
    for value in VALUES:
        (folder / "evaluation.json").write_text(json.dumps({"vertices": value, "fdda": value, "linear": value}))
        (folder / "report.json").write_text(json.dumps({"goal": value, "warnings": value}))
        assert main([str(plan.path), "--report-only"]) == 0, value
        evaluate = tasks["elbow/evaluate-0"]
        for wrong in ({"fdda": value}, {"fdda": {"p999": value}} if value != -1 else {}, value):
            (evaluate.folder / "evaluation.json").write_text(json.dumps(wrong))
            with pytest.raises(ManifestError):
                read_p999_mm(evaluate)


def test_a_last_report_of_wrong_values_is_none(bound):
    plan, _, _ = bound
    plan.path.write_text(plan.path.read_text() + ONE.replace("elbow]", "other]").replace("out/elbow", "out/other"))
    assert main([str(plan.path), "--report-only"]) == 0
    path = plan.path.with_name("report.json")
    good = json.loads(path.read_text())
    own = good["characters"]["elbow"]
    assert own["models"] and own["failures"] == []
    for key in own:
        for value in VALUES:
            wrong = good | {"characters": {name: own | {key: value} for name in ("elbow", "other")}}
            path.write_text(json.dumps(wrong))
            # Of the other nothing is said anew: what the last report says is kept.
            assert main([str(plan.path), "--report-only", "--only", "elbow"]) == 0, (key, value)
    for content in (*JUNK, b'{"characters": 3}'):
        path.write_bytes(content)
        status = main([str(plan.path), "--report-only"])
        assert status == (1 if content else 0), "a file of another kind is not written over"
        path.write_text(json.dumps(good))
