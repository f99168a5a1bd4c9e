# SPDX-License-Identifier: GPL-3.0-or-later
"""Probable causes of the largest errors of a partition, and their remedies.

This module is separate because the report page must not import torch.
"""

TOO_FEW_COMPONENTS, EXTREME_POSES, TOO_FEW_POSES, HIGH_TRAINING_ERRORS, NO_CLEAR_CAUSE = (
    "components",
    "extremes",
    "poses",
    "steep",
    "none",
)
REMEDY_BY_CAUSE = {
    TOO_FEW_COMPONENTS: "more components: a smaller tolerance",
    EXTREME_POSES: "more poses at the extremes: refinement, or a larger spread",
    TOO_FEW_POSES: "more poses",
    HIGH_TRAINING_ERRORS: (
        "little: training poses have the same errors, so the rig flips there, or the networks are too small"
    ),
    NO_CLEAR_CAUSE: "no cause stands out",
}
"""For each cause, the change that is likely to lower the errors. The report page shows it."""
