# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators. Each reads its settings, calls a function of a lower package, and reports the result."""

MODULES: tuple[str, ...] = (
    "job",
    "trainer_environment",
    "trusted_folders",
    "rig",
    "frame_profile",
    "sampling",
    "poses",
    "limits",
    "remedies",
    "recording",
    "training",
    "playback",
    "build_model",
    "baking",
    "fast_rig",
    "evaluation",
    "film",
    "models",
    "help",
    "meshes",
    "clipboard",
)
"""Names of the modules of this package. Each module lists its classes in `CLASSES`."""
