# SPDX-License-Identifier: GPL-3.0-or-later
"""The sidebar panel "FDDA" of the 3D View: a section a module, in the order of the work."""

MODULES: tuple[str, ...] = ("rig", "poses", "recording", "training", "playback", "evaluation", "models")
"""The modules of this package in the order of their sections; each lists its classes in `CLASSES`."""
