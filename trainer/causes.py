# SPDX-License-Identifier: GPL-3.0-or-later
"""What the largest errors of a partition may come from. No torch: the page of a report is written without it."""

SHAPES, CORNERS, POSES, STEEP, EVEN = "shapes", "corners", "poses", "steep", "even"
CAUSES = {
    SHAPES: "more shapes: a smaller tolerance",
    CORNERS: "more poses in the corners: refinement, or a larger spread",
    POSES: "more poses",
    STEEP: "little: poses that trained are as wrong, so the rig turns over there, or units are too few",
    EVEN: "nothing stands out",
}
"""What helps, by cause."""
