# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of Blender's data as arrays."""
