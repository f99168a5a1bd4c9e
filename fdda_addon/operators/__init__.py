# SPDX-License-Identifier: GPL-3.0-or-later
"""The operators: a button each. Poll, gather, call, report; the work is done by the modules below."""

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
"""The modules of this package; each lists its classes in `CLASSES`."""
