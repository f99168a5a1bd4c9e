# SPDX-License-Identifier: GPL-3.0-or-later
"""The format of a recording: read, written, resumed and extended, without Blender."""
