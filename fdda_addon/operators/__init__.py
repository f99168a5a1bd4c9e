# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators. Each gathers its settings, calls a function of a lower package, and reports."""

MODULES: tuple[str, ...] = (
    "job",
    "trainer_environment",
    "trusted_folders",
    "rig",
    "sampling",
    "poses",
    "limits",
    "recording",
    "training",
    "playback",
    "build_model",
    "baking",
    "evaluation",
    "worst_poses",
    "models",
    "help",
    "meshes",
    "clipboard",
)
"""The modules of this package. Each lists its classes in `CLASSES`."""
