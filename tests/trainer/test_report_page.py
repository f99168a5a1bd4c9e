# SPDX-License-Identifier: GPL-3.0-or-later
"""The report's page: whole, self-contained, and written again with pictures and an evaluation."""

import base64
import json
import re
import subprocess
import sys
from html.parser import HTMLParser

from conftest import REPOSITORY

from trainer.report import main

PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


class Tags(HTMLParser):
    """Collects tags; fails on one that is closed and was not open."""

    VOID = ("meta", "img", "line", "rect", "polyline", "polygon")

    def __init__(self, text: str):
        super().__init__()
        self.open, self.seen = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.seen.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag


def test_page_is_well_formed_and_asks_for_nothing(trained, report):
    text = (trained / "report.html").read_text(encoding="utf-8")
    tags = Tags(text)
    assert not tags.open
    assert not re.search(r"(src|href)=\"(?!data:)", text) and "url(" not in text and "@import" not in text
    assert "script" not in {tag for tag, _ in tags.seen}
    charts = [tag for tag, _ in tags.seen if tag == "svg"]
    assert len(charts) == 2 + len(report["partitions"])
    for partition in report["partitions"]:
        assert f"{partition['held_out']['max']:.4f}" in text


def test_written_again_with_pictures_and_evaluation(trained, report, tmp_path):
    (tmp_path / "report.json").write_text(json.dumps(report))
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    (pictures / "two_poses.png").write_bytes(PNG)
    (pictures / "notes.txt").write_text("no picture")
    statistics = {"mean": 0.125, "rms": 0.25, "p99": 0.5, "p999": 1.0, "max": 2.0}
    evaluation = {"unit": "mm", "poses": 200, "vertices": 90, "fdda": statistics, "linear": statistics}
    (tmp_path / "evaluation.json").write_text(json.dumps(evaluation))
    arguments = ["--pictures", pictures, "--evaluation", tmp_path / "evaluation.json"]
    assert main([str(tmp_path / "report.json"), *map(str, arguments)]) == 0
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    images = [attributes for tag, attributes in Tags(text).seen if tag == "img"]
    assert [image["alt"] for image in images] == ["two poses"]
    assert base64.b64decode(images[0]["src"].partition("base64,")[2]) == PNG
    assert "200 poses that training never saw" in text and "0.125 mm" in text


def test_names_from_the_rig_cannot_break_the_page(report, tmp_path):
    report = json.loads(json.dumps(report))
    report["partitions"][0]["joint"] = "<b>&bone</script>"
    (tmp_path / "report.json").write_text(json.dumps(report))
    assert main([str(tmp_path / "report.json")]) == 0
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "</script>" not in text and "&lt;b&gt;&amp;bone" in text


def test_what_is_no_report_is_refused(tmp_path, capsys):
    (tmp_path / "report.json").write_text("{}")
    assert main([str(tmp_path / "report.json")]) == 1
    assert "is not a training report" in capsys.readouterr().err
    assert not (tmp_path / "report.html").exists()


def test_the_page_needs_no_torch(trained):
    code = "import sys; sys.modules['torch'] = None; import trainer.report"
    subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, check=True)
