# SPDX-License-Identifier: GPL-3.0-or-later
"""The tests that need no Blender."""
