# SPDX-License-Identifier: GPL-3.0-or-later
"""The verdict of a training on its accuracy goal."""

from pathlib import Path

import pytest

from fdda_addon.core.formats.report import Verdict
from trainer.goal import evaluate_goal


def evaluate_errors(*errors: float, goal: float = 0.5, training: float = 0.1):
    history = [{"poses": 500 + 250 * index, "p999": error} for index, error in enumerate(errors)]
    return evaluate_goal(goal, history, training, Path("recording"), Path("arm.onnx"))


@pytest.mark.parametrize(
    ("errors", "verdict"),
    [
        ((0.5,), Verdict.MET),
        ((0.51,), Verdict.MISSED),
        ((0.9, 0.8, 0.7), Verdict.MISSED),
        ((0.9, 0.9), Verdict.MISSED),
        ((0.9, 0.89, 0.88), Verdict.EXHAUSTED),
        ((0.9, 0.95, 0.7), Verdict.MISSED),
        ((0.9, 0.95, 0.4), Verdict.MET),
    ],
)
def test_the_errors_determine_the_verdict(errors, verdict):
    assert evaluate_errors(*errors)[0] is verdict


def test_a_missed_goal_gives_advice():
    text = evaluate_errors(0.8)[1]
    assert "within 0.8 mm and the goal is 0.5 mm" in text
    assert "record RIG.blend recording --refine arm.onnx" in text and "--warm-start" in text


def test_an_exhausted_goal_names_the_reason():
    assert "500 more poses brought it there from 0.9 mm" in evaluate_errors(0.9, 0.89, 0.88)[1]
    assert "Narrow the range of motion" in evaluate_errors(0.9, 0.89, 0.88)[1]
    assert (
        "training poses are at 0.85 mm, so the networks are too small"
        in evaluate_errors(0.9, 0.9, 0.9, training=0.85)[1]
    )
