# SPDX-License-Identifier: GPL-3.0-or-later
"""Probable causes of the largest errors of a partition. The report page imports this module without torch."""

COMPONENTS, EXTREMES, POSES, STEEP, NONE = "components", "extremes", "poses", "steep", "none"
CAUSES = {
    COMPONENTS: "more components: a smaller tolerance",
    EXTREMES: "more poses at the extremes: refinement, or a larger spread",
    POSES: "more poses",
    STEEP: "little: training poses have the same errors, so the rig flips there, or the networks are too small",
    NONE: "no cause stands out",
}
"""For each cause, the change that is likely to lower the errors."""
