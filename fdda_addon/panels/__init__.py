# SPDX-License-Identifier: GPL-3.0-or-later
"""The tab "FDDA" in the sidebar of the 3D View. Each module of `MODULES` draws one section."""

MODULES: tuple[str, ...] = ("rig", "poses", "recording", "training", "playback", "evaluation", "models")
"""Names of the modules, in the order of their sections. Each module lists its classes in `CLASSES`."""
