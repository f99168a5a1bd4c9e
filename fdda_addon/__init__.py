# SPDX-License-Identifier: GPL-3.0-or-later
"""Fast and Deep Deformation Approximations for Blender. Importing this needs no bpy; `register` does the work."""
