# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender keeps for us: with a mesh object, with an action, for the session, and in the preferences."""

MODULES: tuple[str, ...] = ("character", "session", "view", "binding", "preferences")
"""The modules of this package in the order in which they need each other; each lists its classes in `CLASSES`."""
