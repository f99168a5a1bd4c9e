# SPDX-License-Identifier: GPL-3.0-or-later
"""What the largest errors have in common is found where it was put."""

import json
from pathlib import Path

import pytest

from trainer.__main__ import main
from trainer.causes import CAUSES, CORNERS, EVEN, POSES, SHAPES, STEEP
from trainer.page import render_html
from trainer.worst import _cause

from .chain import write_chain


def worst_of(folder: Path, poses: int, *options: str) -> list[dict]:
    write_chain(folder / "chain", poses)
    assert main([str(folder / "chain"), str(folder / "chain.onnx"), *options]) == 0
    report = json.loads((folder / "report.json").read_text())
    return report["partitions"]


def test_too_few_shapes(tmp_path):
    """With a tolerance of two millimetres nearly all of the error is what no shape reaches."""
    found = [p for p in worst_of(tmp_path, 200, "--epochs", "60", "--tolerance-mm", "2") if p["held_out"]["max"] > 1]
    assert found and all(p["worst"]["shapes"] > 0.8 and p["worst"]["cause"] == SHAPES for p in found)


def test_too_few_poses(tmp_path):
    """Thirty poses and many epochs: what trained is right, the rest is not."""
    few = worst_of(tmp_path, 30, "--epochs", "300", "--tolerance-mm", "0.001", "--held-out-fraction", "0.4")
    few = max(few, key=lambda p: p["held_out"]["max"])["worst"]
    assert few["training"] > 1.5 and few["cause"] in (POSES, CORNERS)


@pytest.mark.parametrize(
    ("shapes", "distance", "ratio", "cause"),
    [
        (0.9, 3.0, 3.0, SHAPES),
        (0.1, 1.0, 3.0, POSES),
        (0.1, 3.0, 3.0, CORNERS),
        (0.1, 3.0, 1.0, CORNERS),
        (0.1, 1.0, 1.0, STEEP),
        (0.4, 1.0, 1.0, EVEN),
    ],
)
def test_causes(shapes, distance, ratio, cause):
    assert _cause(shapes, distance, ratio) == cause and cause in CAUSES


def test_the_page_says_it(report):
    page = render_html(report)
    assert "The largest errors" in page
    for partition in report["partitions"]:
        assert partition["worst"]["vertices"] <= partition["vertices"]
        curve = partition["curve"]
        assert len(curve["worst"]) == len(curve["validation"])
        assert all(worst >= mean for worst, mean in zip(curve["worst"], curve["validation"], strict=True))
    older = {**report, "partitions": [dict(p, curve=dict(p["curve"])) for p in report["partitions"]]}
    for partition in older["partitions"]:
        del partition["worst"], partition["curve"]["worst"]
    assert "The largest errors" not in render_html(older)
