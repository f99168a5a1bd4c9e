# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings that hold where nobody states others: the same in the sidebar, on the command line, in the trainer and in
scripts. What only one of them has stands there.
"""

POSES = 1000
"""Random poses of a recording."""
SPREAD = 1.0
"""Standard deviation of random poses, as a part of half the range."""
MARGIN = 1.0
"""How many times as wide as the range of motion the poses of its margin are; 1 for none of them."""
INFLUENCE_POSES = 10
"""How often each joint is moved alone to find the partitions that it influences."""
MIN_PARTITION_VERTICES = 8
"""Partitions of fewer vertices are merged into others."""
REFINEMENT_POSES = 250
"""Poses that are added where a model is worst."""
REST_THRESHOLD_MM = 0.1
"""A target that poses are held for is at rest when no vertex moves by more from a frame to the next."""
REPEATABILITY_POSES = 10
"""Poses that are approached from another direction as well."""

TOLERANCE_MM = 0.04
"""What the basis shapes may leave, over the whole mesh."""
EPOCHS = 200
GOAL_MM = 0.0
"""What 99.9 % of the held-out vertices are to be within; 0 for no goal."""
SUGGESTED_GOAL_MM = 0.5
"""The goal that the sidebar suggests when a user turns it on."""

EVALUATION_POSES, SIDEBAR_EVALUATION_POSES = 200, 100
"""Random poses that a model is compared on; fewer where a user waits for them."""
EVALUATION_SEED = 1
"""Of these poses: not that of a recording."""
MARKERS = 5
"""So many of the worst frames are marked."""
