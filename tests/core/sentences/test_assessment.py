# SPDX-License-Identifier: GPL-3.0-or-later
"""What is said about the errors of a training or an evaluation.

The reports in `reports/` are those of the sample arm with 1,476 vertices, trained for 120 epochs on 20 and on 400
poses, without the keys that an assessment does not read.
"""

import copy
import json
from pathlib import Path

import pytest

from fdda_addon.core.mathematics.metrics import ErrorStatistics
from fdda_addon.core.sentences.assessment import (
    PartErrors,
    assess_evaluation,
    assess_training,
    farther_than_skinning_sentence,
    format_mm,
    rising_from_epoch,
)

REPORTS = Path(__file__).parents[1] / "reports"


def read(name: str) -> dict:
    """Read a report; all its body parts have the errors of the whole mesh."""
    report = json.loads((REPORTS / f"{name}.json").read_text(encoding="utf-8")) | {
        "meshes": [{"name": "arm"}],
        "training": {"bones_to_read": "all"},
    }
    for partition in report["partitions"]:
        partition |= {"held_out": report["fdda"]["held_out"], "linear": report["linear"]["held_out"]}
        partition["largest_errors"] = {"cause": "poses"}
    return report


def statistics(mean: float, p999: float, largest: float) -> ErrorStatistics:
    return ErrorStatistics(mean, mean, p999, p999, largest)


def test_a_good_training_is_called_good_with_the_next_step():
    assessment = assess_training(read("arm_400_poses"))
    assert assessment.is_good and assessment.next_step.startswith("Next: bind the model")
    assert assessment.sentence == (
        "arm, unseen poses: 0.032 mm from the rig on average, 78x closer than skinning alone (2.5 mm); at most 2.3 mm, "
        "skinning alone 30.6 mm."
    )


def test_too_few_poses_are_named_with_the_remedy():
    assessment = assess_training(read("arm_20_poses"))
    assert not assessment.is_good and assessment.next_step == ""
    assert assessment.warnings == (
        "The error in unseen poses is 24 times that in seen poses: the model needs more poses. Raise Random Poses or "
        "check more actions, and record.",
    )


def test_a_rising_error_in_unseen_poses_is_named_with_its_pass():
    report = read("arm_400_poses")
    for partition in report["partitions"]:
        curve = partition["curve"]["validation"]
        # From pass 20 on, each pass is 1 % worse than the one before.
        partition["curve"]["validation"] = [
            error if epoch < 20 else curve[19] * 1.01 ** (epoch - 19) for epoch, error in enumerate(curve)
        ]
    assert rising_from_epoch(report["partitions"]) == 20
    assert assess_training(report).warnings[0].startswith("The error in unseen poses rises from pass 20 on")
    # A rise by less than 5 % is noise.
    for partition in report["partitions"]:
        curve = partition["curve"]["validation"]
        curve[20:] = [curve[19] * 1.02] * len(curve[20:])
    assert rising_from_epoch(report["partitions"]) == 0


@pytest.mark.parametrize(
    "errors, start",
    [
        ({"max": 30.0}, "The largest error is 30.0 mm, which hardly beats skinning alone (30.6 mm)"),
        ({"p999": 20.0}, "99.9 % of the points are within 20.0 mm, which hardly beats skinning alone (26.1 mm)"),
        ({"mean": 2.4}, "The model is hardly closer than skinning alone"),
    ],
)
def test_errors_that_hardly_beat_skinning_are_named_with_a_remedy(errors, start):
    report = copy.deepcopy(read("arm_400_poses"))
    report["fdda"]["held_out"].update(errors)
    warning = assess_training(report).warnings[0]
    assert warning.startswith(start)
    assert "Add Poses at Worst Errors" in warning or "record again" in warning
    report["training"]["bones_to_read"] = "4"
    remedy = "the model reads 4 bones. Raise Bones to Read under Advanced, and train again."
    assert assess_training(report).warnings[0].endswith(remedy)


def test_a_rig_that_is_skinning_alone_needs_no_model():
    report = read("arm_400_poses")
    report["linear"]["held_out"].update(mean=0.001)
    assert assess_training(report).warnings[0].startswith("Skinning alone already equals the rig")


def test_a_report_without_curves_is_assessed_by_its_errors():
    report = read("arm_400_poses")
    report["partitions"] = []
    assert assess_training(report).is_good


def test_an_evaluation_is_assessed_with_what_to_do_next():
    skinning = statistics(2.0, 20.0, 25.0)
    good = assess_evaluation(statistics(0.1, 1.0, 2.0), skinning, "body")
    assert good.is_good and good.sentence.startswith("body: 0.10 mm from the rig on average, 20x closer")
    assert good.next_step == "Next: play the action, and look at the worst frames."
    beyond = assess_evaluation(statistics(0.1, 1.0, 24.0), skinning, "body")
    assert "open Confidence in This Pose" in beyond.warnings[0] and beyond.next_step == ""
    unlike = assess_evaluation(statistics(1.9, 19.0, 24.0), skinning, "body")
    assert unlike.warnings[0].startswith("The model is hardly closer than skinning alone: these poses are unlike")
    worse = assess_evaluation(statistics(2.1, 19.0, 24.0), skinning, "body")
    assert worse.warnings[0].startswith("The model is farther from the rig than skinning alone: these poses are unlike")
    other = assess_evaluation(statistics(0.1, 1.0, 2.0), skinning, "body", is_bound=False)
    assert other.warnings == ("Another model is bound now: press Evaluate again.",)
    still = assess_evaluation(statistics(0.0, 0.0, 0.0), statistics(0.0, 0.0, 0.0), "body")
    assert still.warnings[0].startswith("Skinning alone already equals the rig") and "inf" not in still.sentence


@pytest.mark.parametrize(
    ("held_out_mm", "linear_mm", "cause", "warning"),
    [
        # The mean over the arm is 0.032 mm.
        (0.9, 1.0, "poses", ""),
        (
            5.0,
            40.0,
            "poses",
            "The body part of 'palm' is 5.0 mm from the rig on average (skinning alone 40.0 mm): press Add Poses at "
            "Worst Errors, then Continue Training.",
        ),
        (1.2, 1.3, "components", "1.2 mm from the rig on average (skinning alone 1.3 mm): lower Detail (mm)"),
        (1.2, 1.3, "steep", "seen poses have the same errors. Look for a flip of the rig there"),
    ],
)
def test_the_worst_body_part_is_judged_too(held_out_mm, linear_mm, cause, warning):
    report = read("arm_400_poses")
    report["partitions"][3] |= {
        "joint": "palm",
        "held_out": {"mean": held_out_mm},
        "linear": {"mean": linear_mm},
        "largest_errors": {"cause": cause},
    }
    assessment = assess_training(report)
    assert assessment.is_good == (not warning) and warning in "".join(assessment.warnings)
    parts = [PartErrors("palm", held_out_mm, linear_mm), PartErrors("", 0.01, 1.0)]
    evaluation = assess_evaluation(statistics(0.032, 0.7, 2.3), statistics(2.5, 26.0, 30.6), "arm", parts)
    assert evaluation.is_good == (not warning)
    assert all("The body part of 'palm' is " in text for text in evaluation.warnings)


def test_a_cause_in_the_recording_comes_before_more_poses():
    seams = {"name": "open-seams", "text": "2,399 vertices come apart by up to 165 mm; merge them by distance."}
    others = [{"name": "dead-joints", "text": "no cause"}, {"name": "large-residuals", "text": "a symptom."}]
    report = read("arm_20_poses") | {"warnings": [*others, seams]}
    report["linear"]["held_out"].update(mean=0.7)
    assert assess_training(report).warnings == (
        "The model is hardly closer than skinning alone. Likely cause: 2,399 vertices come apart by up to 165 mm; "
        "merge them by distance.",
        "The error in unseen poses is 24 times that in seen poses.",
    )
    evaluation = assess_evaluation(
        statistics(1.9, 19.0, 24.0), statistics(2.0, 20.0, 25.0), "arm", (), report["warnings"]
    )
    assert "Likely cause: 2,399 vertices come apart" in evaluation.warnings[0]
    # A good model needs no cause, and a warning that explains no errors is none.
    assert assess_training(read("arm_400_poses") | {"warnings": [seams]}).is_good
    assert "needs more poses" in assess_training(read("arm_20_poses") | {"warnings": others[:1]}).warnings[0]


def test_a_model_that_is_farther_than_skinning_is_named():
    assert farther_than_skinning_sentence(0.549, 0.394) == (
        "The model is farther from the rig than linear skinning here, 0.55 instead of 0.39 mm on average: record more "
        "such poses, or play them without the model."
    )
    assert farther_than_skinning_sentence(0.39, 0.394) == ""
    # Ratios of errors that nobody sees mean nothing.
    assert farther_than_skinning_sentence(0.009, 0.001) == ""


def test_a_model_that_is_far_where_skinning_is_the_rig_is_named():
    exact = statistics(0.0, 0.0, 0.0)
    assert "5.0 instead of 0.000 mm" in farther_than_skinning_sentence(5.0, 0.0)
    far = assess_evaluation(statistics(5.0, 20.0, 30.0), exact, "body")
    assert far.warnings[0].startswith("The model is farther from the rig than skinning alone: these poses are unlike")
    near = statistics(0.03, 0.1, 0.2)
    assert farther_than_skinning_sentence(near.mean, exact.mean) == ""
    assert assess_evaluation(near, exact, "body").warnings[0].startswith("Skinning alone already equals the rig")


@pytest.mark.parametrize(
    "value, text", [(0, "0.000"), (0.0243, "0.024"), (0.5, "0.50"), (7.53, "7.5"), (44.27, "44.3"), (31643.7, "31,644")]
)
def test_millimeters_have_the_digits_that_matter(value, text):
    assert format_mm(value) == text
