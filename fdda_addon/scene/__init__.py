# SPDX-License-Identifier: GPL-3.0-or-later
"""The border between Blender's data and arrays: everything here needs bpy, and nothing here decides anything."""
