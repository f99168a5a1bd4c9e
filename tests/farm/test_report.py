# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of the report of all characters: errors, failures, changes, and escaping of names."""

import json
from html.parser import HTMLParser

from farm.fingerprints import TaskManifest, write_manifest
from farm.page import render_page
from farm.report import write_report
from farm.run import FAILED, Outcome
from farm.tasks import make_tasks

from .conftest import ONE_CHARACTER

PNG = b"\x89PNG\r\n\x1a\n"


def write_results(plan, mean: float, key: str = "first") -> None:
    """Write the manifests and results of all tasks, as if they had run."""
    for task in make_tasks(plan).values():
        task.folder.mkdir(parents=True, exist_ok=True)
        notes = {"bound": {"elbow.onnx": "elbow/train-0"}} if task.kind == "bind" else {}
        write_manifest(task, TaskManifest(key, {}, seconds=2.0, peak_mb=100.0, host="here", notes=notes))
    errors = {"mean": mean, "p999": 10 * mean, "max": 20 * mean}
    folder = make_tasks(plan)["elbow/bind"].folder
    (folder / "evaluation.json").write_text(json.dumps({"vertices": 300, "fdda": errors, "linear": errors}))
    warnings = [{"name": "flips", "text": "Bones <flip> & turn."}]
    (folder / "report.json").write_text(json.dumps({"warnings": warnings, "goal": {"verdict": "missed"}}))
    (folder / "heat_map.png").write_bytes(PNG)


def test_the_report_compares_errors_with_the_last_run(write_plan):
    plan = write_plan(ONE_CHARACTER + "goal_mm = 0.5\nrounds = 0\n")
    page, tasks = plan.path.with_name("report.html"), make_tasks(plan)
    read_report = lambda: json.loads(page.with_suffix(".json").read_text())["characters"]["elbow"]  # noqa: E731
    write_results(plan, 0.1)
    write_report(plan, tasks, {}, page)
    assert read_report()["state"] == "done" and read_report()["before"] is None
    write_results(plan, 0.05, "second")
    write_report(plan, tasks, {}, page)
    assert read_report()["before"]["models"][0]["fdda"]["mean"] == 0.1
    assert "-50 %" in page.read_text() and "0.5 met" in page.read_text()
    # A run without changes keeps the comparison of the last run.
    write_report(plan, tasks, {}, page)
    assert read_report()["before"]["models"][0]["fdda"]["mean"] == 0.1


def test_a_failure_is_reported_and_escaped(write_plan):
    plan = write_plan()
    page, tasks = plan.path.with_name("report.html"), make_tasks(plan)
    write_results(plan, 0.1)
    sentence = "'<script>alert(1)</script>' & more."
    write_report(plan, tasks, {"elbow/train-0": Outcome("elbow/train-0", FAILED, sentence)}, page)
    text = page.read_text()
    assert "&#x27;&lt;script&gt;alert(1)&lt;/script&gt;&#x27; &amp; more." in text and "<script" not in text
    character = json.loads(page.with_suffix(".json").read_text())["characters"]["elbow"]
    assert character["state"] == "failed" and character["models"] == []
    assert character["failures"][0]["sentence"] == sentence


def test_the_page_is_well_formed_and_self_contained(write_plan):
    """All tags are closed, and no file is loaded from elsewhere."""
    plan = write_plan(ONE_CHARACTER + "goal_mm = 0.5\nrounds = 0\n")
    page, tasks = plan.path.with_name("report.html"), make_tasks(plan)
    write_results(plan, 0.1)
    write_report(plan, tasks, {}, page)
    text, open_tags, sources = page.read_text(), [], []

    class Reader(HTMLParser):
        def handle_starttag(self, tag: str, attributes: list) -> None:
            sources.extend(value for name, value in attributes if name in ("src", "href"))
            if tag not in ("meta", "img", "br"):
                open_tags.append(tag)

        def handle_endtag(self, tag: str) -> None:
            assert open_tags.pop() == tag

    Reader().feed(text)
    assert open_tags == [] and sources and all(source.startswith("data:image/png;base64,") for source in sources)
    assert "Bones &lt;flip&gt; &amp; turn." in text and "0.5 missed" in text


def test_a_damaged_last_report_is_ignored(write_plan):
    plan = write_plan()
    page, tasks = plan.path.with_name("report.html"), make_tasks(plan)
    page.with_suffix(".json").write_text('{"format": "fdda-farm-report", "version": 1, "characters": {"elbow": 3}}')
    write_report(plan, tasks, {}, page)
    character = json.loads(page.with_suffix(".json").read_text())["characters"]["elbow"]
    assert character["state"] == "not done" and character["before"] is None
    assert render_page({"plan": "p", "written": "now", "characters": {}}, {}).startswith("<!doctype html>")
