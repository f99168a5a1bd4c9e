# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads, writes, resumes, extends and merges recordings, without Blender."""
