# SPDX-License-Identifier: GPL-3.0-or-later
"""Default settings shared by the sidebar, the command line, the trainer and scripts.

A default that only one of them uses is defined there.
"""

POSES = 1000
"""Number of random poses in a recording."""
SPREAD = 1.0
"""Standard deviation of random poses, as a ratio of half the range of motion."""
MARGIN = 1.0
"""Factor by which the range of motion is scaled for poses of the margin (`poses.Margin`); 1 for no margin."""
MIN_PARTITION_VERTICES = 8
"""Partitions with fewer vertices are merged into others."""
REFINEMENT_POSES = 250
"""Number of poses that a refinement adds where the error of a model is largest."""
REST_THRESHOLD_MM = 0.1
"""Millimeters per frame. A target is at rest when no vertex moves by more between two frames."""
REPEATABILITY_POSES = 10
"""Number of poses that a simulated target reaches a second time, from another direction."""

TOLERANCE_MM = 0.04
"""Allowed rms error of the principal components alone, over training poses and all vertices, mm."""
EPOCHS = 200

EVALUATION_POSES, SIDEBAR_EVALUATION_POSES = 200, 100
"""Numbers of random poses in which a model is compared with its rig; fewer in the sidebar, where the user waits."""
EVALUATION_SEED = 1
"""Seed of the poses of an evaluation; it differs from the default seed of a recording."""
FILM_TIMED_FRAMES = 50
"""Number of frames that are timed for the frame times in a film."""
MARKERS = 5
"""Number of frames that an evaluation marks in the timeline, those with the largest errors."""
