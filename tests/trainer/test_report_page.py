# SPDX-License-Identifier: GPL-3.0-or-later
"""The report's page is complete and self-contained; errors are analyzed by their causes."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from fdda_addon.core.mathematics.partition import make_partitions
from trainer.__main__ import main
from trainer.report.error_analysis import (
    EXTREME_POSES,
    HIGH_TRAINING_ERRORS,
    NO_CLEAR_CAUSE,
    REMEDY_BY_CAUSE,
    TOO_FEW_COMPONENTS,
    TOO_FEW_POSES,
    UNPREDICTED_COMPONENTS,
    _cause,
)
from trainer.report.page import render_html

from ..recordings import write_recording
from .chain import chain_angles, chain_info, chain_rig, pose_chain, write_chain


class TagCollector(HTMLParser):
    """Collects the tags of a page, and fails on a closing tag without its opening tag."""

    VOID_TAGS = ("meta", "line", "rect", "polyline", "polygon")

    def __init__(self, text: str):
        super().__init__()
        self.open_tags, self.tags = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in self.VOID_TAGS:
            self.open_tags.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID_TAGS:
            assert self.open_tags.pop() == tag


def test_page_is_well_formed_and_loads_nothing(trained, report):
    text = (trained / "report.html").read_text(encoding="utf-8")
    collector = TagCollector(text)
    assert not collector.open_tags
    assert not re.search(r"(src|href)=\"(?!data:)", text) and "url(" not in text and "@import" not in text
    assert "script" not in {tag for tag, _ in collector.tags}
    charts = [tag for tag, _ in collector.tags if tag == "svg"]
    assert len(charts) == 2 + len(report["partitions"])
    for partition in report["partitions"]:
        assert f"{partition['held_out']['max']:.4f}" in text


def test_names_from_the_rig_cannot_break_the_page(report):
    report = json.loads(json.dumps(report))
    report["partitions"][0]["joint"] = "<b>&bone</script>"
    text = render_html(report)
    assert "</script>" not in text and "&lt;b&gt;&amp;bone" in text


def train_chain(folder: Path, poses: int, *options: str) -> list[dict]:
    write_chain(folder / "chain", poses)
    assert main([str(folder / "chain"), str(folder / "chain.onnx"), *options]) == 0
    report = json.loads((folder / "report.json").read_text())
    return report["partitions"]


def test_too_few_components_are_the_cause(tmp_path):
    """With a tolerance of two millimeters, components do not represent most of the error."""
    partitions = train_chain(tmp_path, 200, "--passes", "60", "--detail-mm", "2")
    analyses = [p["largest_errors"] for p in partitions if p["held_out"]["max"] > 1]
    assert analyses and all(a["truncation"] > 0.8 and a["cause"] == TOO_FEW_COMPONENTS for a in analyses)


def test_too_few_poses_are_the_cause(tmp_path):
    """With forty poses and many epochs, the training poses are accurate and the other poses are not."""
    partitions = train_chain(tmp_path, 40, "--passes", "300", "--detail-mm", "0.001", "--held-out-fraction", "0.4")
    analysis = max(partitions, key=lambda p: p["held_out"]["max"])["largest_errors"]
    assert analysis["generalization"] > 1.5 and analysis["cause"] in (TOO_FEW_POSES, EXTREME_POSES)


@pytest.mark.parametrize(
    ("detail_mm", "tolerance_mm", "cause"), [(0.0, 0.1, UNPREDICTED_COMPONENTS), (3.0, 3.2, TOO_FEW_COMPONENTS)]
)
def test_dropped_components_are_the_cause_only_if_most_of_the_error_is_in_them(
    tmp_path, detail_mm, tolerance_mm, cause
):
    """One large pattern is random in each pose; so are many small ones, which are within the tolerance."""
    rig, poses, rng = chain_rig(2), 200, np.random.default_rng(0)
    angles, patterns = chain_angles(poses, 2, 0), rng.normal(size=(41, rig.vertex_count * 3)) / np.sqrt(3)
    sizes = np.append(2.0, np.full(40, detail_mm / np.sqrt(40))) / 1000
    residuals = ((rng.normal(size=(poses, 41)) * sizes) @ patterns).reshape(poses, rig.vertex_count, 3)
    partitions = make_partitions(rig, {0: (1,), 1: (1,)})
    write_recording(
        tmp_path / "recording",
        rig,
        partitions,
        chain_info(poses),
        pose_chain(rig, angles),
        residuals.astype(np.float32),
    )
    options = ("--passes", "60", "--detail-mm", str(tolerance_mm))
    assert main([str(tmp_path / "recording"), str(tmp_path / "model.onnx"), *options]) == 0
    dropped = [p for p in json.loads((tmp_path / "report.json").read_text())["partitions"] if p["dropped"]]
    assert dropped and {p["largest_errors"]["cause"] for p in dropped} == {cause}


@pytest.mark.parametrize(
    ("truncation", "is_dropped", "distance", "generalization", "cause"),
    [
        (0.9, False, 3.0, 3.0, TOO_FEW_COMPONENTS),
        (0.9, True, 3.0, 3.0, UNPREDICTED_COMPONENTS),
        (0.1, True, 1.0, 3.0, TOO_FEW_POSES),
        (0.1, False, 3.0, 3.0, EXTREME_POSES),
        (0.1, False, 3.0, 1.0, EXTREME_POSES),
        (0.1, False, 1.0, 1.0, HIGH_TRAINING_ERRORS),
        (0.4, False, 1.0, 1.0, NO_CLEAR_CAUSE),
    ],
)
def test_measured_ratios_determine_the_cause(truncation, is_dropped, distance, generalization, cause):
    assert _cause(truncation, is_dropped, distance, generalization) == cause and cause in REMEDY_BY_CAUSE


def test_the_page_shows_the_analysis(report):
    page = render_html(report)
    assert "The largest errors" in page
    for partition in report["partitions"]:
        assert partition["largest_errors"]["vertices"] <= partition["vertices"]
        curve = partition["curve"]
        assert len(curve["worst"]) == len(curve["validation"])
        assert all(worst >= mean for worst, mean in zip(curve["worst"], curve["validation"], strict=True))
