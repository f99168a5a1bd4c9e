# SPDX-License-Identifier: GPL-3.0-or-later
"""The error that the user asks for, and what to do when a training misses it."""

from dataclasses import dataclass
from pathlib import Path

from fdda_addon.core.report import Verdict

HELPS = 0.97
"""More poses help when they bring the error to less than this part of the best before."""
PATIENCE = 2
"""Trainings in a row that may not have helped."""
SMALL_GAP = 0.8
"""Where the error on the training poses is above this part of the held-out one, more poses bring little: the networks
cannot follow even those that they have seen."""


@dataclass(frozen=True)
class GoalResult:
    """How a training meets the accuracy goal.

    Attributes:
        goal_mm: what 99.9 % of the held-out vertices are to be within.
        p999_mm: what they are within.
        verdict: what follows.
        text: the same as sentences for the user.
    """

    goal_mm: float
    p999_mm: float
    verdict: Verdict
    text: str

    def to_json(self) -> dict:
        return {"goal": self.goal_mm, "p999": self.p999_mm, "verdict": self.verdict.value}


def evaluate_goal(
    goal_mm: float, history: list[dict], training_p999_mm: float, recording: Path, model: Path
) -> GoalResult:
    """Compare the held-out error with the accuracy goal.

    Args:
        goal_mm: asked for.
        history: held-out errors of the trainings so far, the last of which has just ended: `{"poses", "p999"}`, mm.
        training_p999_mm: error of the last on its own training poses, mm.
        recording, model: for the sentence.
    """
    p999 = history[-1]["p999"]
    reached = f"99.9 % of the held-out vertices are within {p999:.3g} mm and the goal is {goal_mm:g} mm"
    if p999 <= goal_mm:
        return GoalResult(goal_mm, p999, Verdict.MET, f"The goal is met: {reached}.")
    if not _exhausted([entry["p999"] for entry in history]):
        text = (
            f"The goal is missed: {reached}. Add poses where the model is worst (record RIG.blend {recording} "
            f"--refine {model}) and train on with --warm-start, or let train do both with --refine RIG.blend."
        )
        return GoalResult(goal_mm, p999, Verdict.MISSED, text)
    before = history[-1 - PATIENCE]
    more = history[-1]["poses"] - before["poses"]
    text = (
        f"The goal is missed and more poses no longer help: {reached}; {more} more poses brought it there from "
        f"{before['p999']:.3g} mm. "
    )
    if training_p999_mm > SMALL_GAP * p999:
        text += (
            f"The training poses are at {training_p999_mm:.3g} mm, so the networks are too small or the basis too "
            "coarse: train with --hidden 128 128 and a smaller --tolerance-mm."
        )
    else:
        text += "Narrow the range of motion to what is animated, or accept this error."
    return GoalResult(goal_mm, p999, Verdict.EXHAUSTED, text)


def _exhausted(errors: list[float]) -> bool:
    """Whether the last trainings, each on more poses, did not help."""
    if len(errors) <= PATIENCE:
        return False
    return min(errors[-PATIENCE:]) > HELPS * min(errors[:-PATIENCE])
