# SPDX-License-Identifier: GPL-3.0-or-later
"""Default settings shared by the sidebar, the command line, the trainer and scripts.

A default that only one of them uses is defined there.
"""

POSES = 1000
"""Number of random poses in a recording."""
SPREAD = 1.0
"""Standard deviation of random poses, as a ratio of half the range of motion."""
MARGIN = 1.0
"""Scale of the range of motion for poses of the margin; 1 for no margin."""
INFLUENCE_POSES = 10
"""How many times each joint is moved alone to find the partitions that it influences."""
MIN_PARTITION_VERTICES = 8
"""Partitions with fewer vertices are merged into others."""
REFINEMENT_POSES = 250
"""Number of poses that are added where a model is worst."""
REST_THRESHOLD_MM = 0.1
"""Millimeters per frame. A target is at rest when no vertex moves by more between two frames."""
REPEATABILITY_POSES = 10
"""Number of poses that a simulated target reaches a second time, from another direction."""

TOLERANCE_MM = 0.04
"""Rms distance over training poses and all vertices that the principal components may leave, mm."""
EPOCHS = 200

EVALUATION_POSES, SIDEBAR_EVALUATION_POSES = 200, 100
"""Numbers of random poses on which a model is compared; fewer in the sidebar, where the user waits."""
EVALUATION_SEED = 1
"""Seed of these poses; it differs from the default seed of a recording."""
MARKERS = 5
"""Number of the worst frames that get a marker."""
