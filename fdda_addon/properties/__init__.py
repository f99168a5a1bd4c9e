# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender properties of mesh objects, actions and the session, and the preferences."""

MODULES: tuple[str, ...] = ("character", "session", "view", "binding", "preferences")
"""Names of the modules of this package, in the order of their dependencies. Each lists its classes in `CLASSES`."""
