# SPDX-License-Identifier: GPL-3.0-or-later
"""Says in sentences what the errors of a training or an evaluation mean, and what to do next."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ..mathematics.metrics import ErrorStatistics
from ..settings import MAX_DETAIL_MM

MAX_GOOD_RATIO = 0.7
"""Largest ratio of an error of the model to that of skinning alone at which the model clearly beats it."""
MIN_SKINNING_ERROR_MM = 0.01
"""With a smaller mean error, skinning alone is the rig, and a model brings nothing."""
MIN_RISE_RATIO = 1.05
"""Ratio of the last to the smallest error in unseen poses from which the error counts as rising."""
MIN_OVERFIT_RATIO = 3.0
"""Ratio of the errors in unseen and in seen poses from which the model needs more poses."""
MAX_UNNOTICED_RATIO = 0.3
"""Ratio of percentile 99.9 of the model to that of skinning alone up to which a model is good however well it fits."""
MIN_VISIBLE_MM = 1.0
"""Smallest mean error of a body part that counts as visible."""
MAX_PART_RATIO = 5.0
"""Largest ratio of the mean error of a body part to that of the whole mesh without a warning."""
RECORDING_CAUSES = (
    *("units", "axes", "open-seams", "hidden-inputs", "hysteresis", "flips", "target-place", "frozen-frames"),
    *("frame-jumps", "degenerate-poses", "duplicate-poses", "large-residuals"),
)
"""Names of the warnings about a recording that explain large errors, the most likely cause first."""
ADD_POSES = "press Add Poses at Worst Errors, then Continue Training"
PART_REMEDIES = {
    "components": "lower Detail (mm) under Advanced, and train again",
    "steep": "seen poses have the same errors. Look for a flip of the rig there, and for inputs that the list lacks",
}
"""Remedies by the cause of the largest errors of a body part; for the others, more poses help."""
LAST_EPOCHS = 5
"""Number of epochs whose mean is the last error; single epochs vary."""


@dataclass(frozen=True)
class Assessment:
    """What errors mean.

    Attributes:
        sentence: the errors, compared with skinning alone.
        warnings: what is wrong, each with its remedy; empty for a good result.
        next_step: what to do next; empty if there are warnings.
    """

    sentence: str
    warnings: tuple[str, ...]
    next_step: str

    @property
    def is_good(self) -> bool:
        """Return whether there are no warnings."""
        return not self.warnings


class PartErrors(NamedTuple):
    """Errors of a body part, mm.

    Attributes:
        joint: name of its main joint; empty for no bone.
        model, skinning: mean errors of the model and of skinning alone.
        cause: cause of its largest errors (`trainer.report.error_analysis`); empty where unknown.
    """

    joint: str
    model: float
    skinning: float
    cause: str = ""


def assess_training(report: Mapping) -> Assessment:
    """Assess a training.

    Args:
        report: the content of `report.json`, as `core.formats.report.read_report` returns it.
    """
    model, skinning = (ErrorStatistics.from_json(report[method]["held_out"]) for method in ("fdda", "linear"))
    parts = [
        PartErrors(p["joint"], p["held_out"]["mean"], p["linear"]["mean"], p["largest_errors"]["cause"])
        for p in report["partitions"]
    ]
    problems = []
    bones = report["training"]["bones_to_read"]
    remedy = f"the model reads {bones} bones. Raise Bones to Read under Advanced, and train again"
    few_bones = remedy if bones.isdigit() else ""
    if skinning.mean < MIN_SKINNING_ERROR_MM:
        problems.append(("Skinning alone already equals the rig, so a model brings nothing here", ""))
    elif _ratio(model.mean, skinning.mean) > MAX_GOOD_RATIO:
        remedy = few_bones or "set Rotation Limits, raise Random Poses, and record again"
        problems.append((_describe_no_gain(model.mean, skinning.mean), remedy))
    elif part := _worst_part(parts, model.mean):
        problems.append((_describe_part(part), few_bones or PART_REMEDIES.get(part.cause, ADD_POSES)))
    elif tail := _unimproved_tail(model, skinning):
        problems.append((tail, few_bones or ADD_POSES))
    if overfit := _describe_overfitting(report, _ratio(model.p999, skinning.p999)):
        problems.append((overfit, "the model needs more poses. Raise Random Poses or check more actions, and record"))
    warnings = _describe_problems(problems, report.get("warnings", ()))
    next_step = "" if warnings else "Next: bind the model, then compare it with the rig on an action."
    names = ", ".join(mesh["name"] for mesh in report["meshes"])
    return Assessment(f"{names}, unseen poses: {describe_errors(model, skinning)}", warnings, next_step)


def assess_evaluation(
    model: ErrorStatistics,
    skinning: ErrorStatistics,
    mesh_name: str,
    parts: Sequence[PartErrors] = (),
    recording_warnings: Sequence[Mapping] = (),
    is_bound: bool = True,
) -> Assessment:
    """Assess the comparison of a model with its rig.

    Args:
        model, skinning: errors of the model and of skinning alone, over all vertices and poses.
        mesh_name: name of the mesh object.
        parts: errors of its body parts.
        recording_warnings: warnings about the recording of the model, as in its report.
        is_bound: whether the compared model is still bound.
    """
    problems = []
    if not is_bound:
        problems.append(("Another model is bound now", "press Evaluate again"))
    elif skinning.mean < MIN_SKINNING_ERROR_MM and not _is_farther(model.mean, skinning.mean):
        problem = "Skinning alone already equals the rig in these poses, so they do not show what the model does"
        problems.append((problem, ""))
    elif _ratio(model.mean, skinning.mean) > MAX_GOOD_RATIO:
        remedy = "these poses are unlike the recorded ones. Check this action in Training Poses, record and train again"
        problems.append((_describe_no_gain(model.mean, skinning.mean), remedy))
    elif problem := _describe_part(_worst_part(parts, model.mean)) or _unimproved_tail(model, skinning):
        remedy = (
            "click a worst frame and open Confidence in This Pose. Below 100 %, widen the limits; else press Add Poses "
            "at Worst Errors"
        )
        problems.append((problem, remedy))
    warnings = _describe_problems(problems, recording_warnings if is_bound else ())
    next_step = "" if warnings else "Next: play the action, and look at the worst frames."
    return Assessment(f"{mesh_name}: {describe_errors(model, skinning)}", warnings, next_step)


def _describe_problems(problems: Sequence[tuple[str, str]], recording_warnings: Sequence[Mapping]) -> tuple[str, ...]:
    """Return a sentence for each problem with its remedy, or with the cause that the recording gives in its place.

    Args:
        problems: each problem and its remedy, without their ends; a problem without a remedy has no cause.
        recording_warnings: warnings about the recording: "name" and "text".
    """
    causes = sorted(
        (warning for warning in recording_warnings if warning["name"] in RECORDING_CAUSES),
        key=lambda warning: RECORDING_CAUSES.index(warning["name"]),
    )
    if causes and any(remedy for _, remedy in problems):
        cause = causes[0]["text"].removesuffix(".")
        return (f"{problems[0][0]}. Likely cause: {cause}.", *(f"{problem}." for problem, _ in problems[1:]))
    return tuple(f"{problem}: {remedy}." if remedy else f"{problem}." for problem, remedy in problems)


def _worst_part(parts: Sequence[PartErrors], mean_mm: float) -> PartErrors | None:
    """Return the body part whose error is visible, and far above the mean error or hardly below that of skinning."""
    worst = max(parts, key=lambda part: part.model, default=None)
    if worst is None or worst.model < MIN_VISIBLE_MM:
        return None
    is_outlier = worst.model > MAX_PART_RATIO * mean_mm or _ratio(worst.model, worst.skinning) > MAX_GOOD_RATIO
    return worst if is_outlier else None


def _describe_part(part: PartErrors | None) -> str:
    """Return a sentence without its end about the worst body part; empty without one."""
    if part is None:
        return ""
    return (
        f"The body part of {repr(part.joint) if part.joint else 'no bone'} is {format_mm(part.model)} mm from the rig "
        f"on average (skinning alone {format_mm(part.skinning)} mm)"
    )


def describe_errors(model: ErrorStatistics, skinning: ErrorStatistics) -> str:
    """Return a sentence that compares the errors of a model with those of skinning alone."""
    comparison = f"skinning alone {format_mm(skinning.mean)} mm"
    if model.mean > 0 and skinning.mean > model.mean:
        comparison = (
            f"{_format_factor(skinning.mean / model.mean)}x closer than skinning alone ({format_mm(skinning.mean)} mm)"
        )
    return (
        f"{format_mm(model.mean)} mm from the rig on average, {comparison}; at most {format_mm(model.max)} mm, "
        f"skinning alone {format_mm(skinning.max)} mm."
    )


def farther_than_skinning_sentence(model_mm: float, skinning_mm: float) -> str:
    """Return a sentence about a model that is farther from the rig than skinning alone; empty if it is closer.

    Args:
        model_mm: mean error of the model, mm.
        skinning_mm: mean error of skinning alone, mm.
    """
    if not _is_farther(model_mm, skinning_mm):
        return ""
    return (
        f"The model is farther from the rig than linear skinning here, {format_mm(model_mm)} instead of "
        f"{format_mm(skinning_mm)} mm on average: record more such poses, or play them without the model."
    )


def rising_from_epoch(partitions: Sequence[Mapping]) -> int:
    """Return the epoch from which the error in unseen poses rises until the end of a training; 0 if it does not.

    Args:
        partitions: the partitions of a report: "vertices", and "curve" with the rms error "validation" after each
            epoch, mm. The partitions are weighted by their vertices.
    """
    errors = _mean_curve(partitions, "validation")
    if len(errors) < 4 * LAST_EPOCHS:
        return 0
    best_epoch = errors.index(min(errors)) + 1
    is_early = best_epoch <= len(errors) - 2 * LAST_EPOCHS
    return best_epoch if is_early and _last(errors) > MIN_RISE_RATIO * min(errors) else 0


def _describe_overfitting(report: Mapping, tail_ratio: float) -> str:
    """Return a sentence without its end about errors in unseen poses that stay behind; empty if there is nothing."""
    partitions = report["partitions"]
    if epoch := rising_from_epoch(partitions):
        return f"The error in unseen poses rises from pass {epoch} on"
    seen, unseen = (_last(_mean_curve(partitions, name)) for name in ("training", "validation"))
    if tail_ratio > MAX_UNNOTICED_RATIO and unseen > MIN_OVERFIT_RATIO * seen > 0:
        return f"The error in unseen poses is {_format_factor(unseen / seen)} times that in seen poses"
    return ""


def _mean_curve(partitions: Sequence[Mapping], name: str) -> list[float]:
    """Return the rms over the trained partitions of a curve, mm by epoch, weighted by their vertices."""
    partitions = [partition for partition in partitions if partition["curve"][name]]
    count = min((len(partition["curve"][name]) for partition in partitions), default=0)
    vertex_count = sum(partition["vertices"] for partition in partitions)
    squares = [
        sum(partition["vertices"] * partition["curve"][name][epoch] ** 2 for partition in partitions)
        for epoch in range(count)
    ]
    return [math.sqrt(square / vertex_count) for square in squares]


def _last(errors: Sequence[float]) -> float:
    """Return the mean of the last errors; 0 without errors."""
    last = errors[-LAST_EPOCHS:]
    return sum(last) / len(last) if last else 0.0


def format_mm(value: float) -> str:
    """Return an error with the digits that matter: "0.024", "0.24", "2.4", "24"."""
    if value < 0.1:
        return f"{value:.3f}"
    if value < 1:
        return f"{value:.2f}"
    return f"{value:.1f}" if value < 100 else f"{value:,.0f}"


def _unimproved_tail(model: ErrorStatistics, skinning: ErrorStatistics) -> str:
    """Return a sentence without its end about largest errors that hardly beat skinning alone; empty if all beat it."""
    for label, name in (("99.9 % of the points are within", "p999"), ("The largest error is", "max")):
        model_mm, skinning_mm = getattr(model, name), getattr(skinning, name)
        if _ratio(model_mm, skinning_mm) > MAX_GOOD_RATIO:
            return f"{label} {format_mm(model_mm)} mm, which hardly beats skinning alone ({format_mm(skinning_mm)} mm)"
    return ""


def _is_farther(model_mm: float, skinning_mm: float) -> bool:
    """Return whether a model is farther from the rig than skinning alone, by more than its tolerance allows."""
    return model_mm > (MAX_DETAIL_MM if skinning_mm < MIN_SKINNING_ERROR_MM else skinning_mm)


def _describe_no_gain(model_mm: float, skinning_mm: float) -> str:
    comparison = "farther from the rig" if _is_farther(model_mm, skinning_mm) else "hardly closer"
    return f"The model is {comparison} than skinning alone"


def _ratio(model_mm: float, skinning_mm: float) -> float:
    return model_mm / skinning_mm if skinning_mm > 0 else math.inf


def _format_factor(factor: float) -> str:
    return f"{factor:.1f}" if factor < 10 else f"{factor:.0f}"
