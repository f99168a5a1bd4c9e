# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of rules for the source code, the documentation and the setup scripts; none of them starts Blender."""
