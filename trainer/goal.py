# SPDX-License-Identifier: GPL-3.0-or-later
"""The accuracy goal: the error that a user asks for, and advice when a training misses it."""

from pathlib import Path

from fdda_addon.core.formats.report import Verdict

MAX_IMPROVED_RATIO = 0.97
"""More poses help when the error is below this part of the lowest earlier error."""
PATIENCE = 2
"""Number of trainings without improvement after which more poses no longer help."""
UNDERFITTING_RATIO = 0.8
"""Ratio of training error to held-out error above which the networks underfit, so that more poses help little."""


def evaluate_goal(
    goal_mm: float, history: list[dict], training_p999_mm: float, recording: Path, model: Path
) -> tuple[Verdict, str]:
    """Compare the held-out error with the accuracy goal.

    Args:
        goal_mm: distance that 99.9 % of the held-out vertices should not exceed, mm.
        history: pose count and held-out error of all trainings, this one last: `{"poses", "p999"}`, mm.
        training_p999_mm: 99.9th percentile of this training's errors on its training poses, mm.
        recording, model: paths that the advice names.

    Returns:
        Whether the training meets the goal, or whether more poses may help; and this in sentences, with advice.
    """
    p999 = history[-1]["p999"]
    comparison = f"99.9 % of the held-out vertices are within {p999:.3g} mm and the goal is {goal_mm:g} mm"
    if p999 <= goal_mm:
        return Verdict.MET, f"The goal is met: {comparison}."
    errors = [entry["p999"] for entry in history]
    if len(errors) <= PATIENCE or min(errors[-PATIENCE:]) <= MAX_IMPROVED_RATIO * min(errors[:-PATIENCE]):
        text = (
            f"The goal is missed: {comparison}. Add poses where the model is worst (record RIG.blend {recording} "
            f"--refine {model}) and train on with --warm-start, or let train do both with --refine RIG.blend."
        )
        return Verdict.MISSED, text
    earlier = history[-1 - PATIENCE]
    added_poses = history[-1]["poses"] - earlier["poses"]
    text = (
        f"The goal is missed and more poses no longer help: {comparison}; {added_poses} more poses brought it there "
        f"from {earlier['p999']:.3g} mm. "
    )
    if training_p999_mm > UNDERFITTING_RATIO * p999:
        text += (
            f"The training poses are at {training_p999_mm:.3g} mm, so the networks are too small or the basis too "
            "coarse: train with --hidden 128 128 and a smaller --detail-mm."
        )
    else:
        text += "Narrow the range of motion to what is animated, or accept this error."
    return Verdict.EXHAUSTED, text
