# SPDX-License-Identifier: GPL-3.0-or-later
"""The tab "FDDA" in the sidebar of the 3D View. Each module has one section."""

MODULES: tuple[str, ...] = ("rig", "poses", "recording", "training", "playback", "evaluation", "models")
"""Modules in the order of their sections. Each lists its classes in `CLASSES`."""
