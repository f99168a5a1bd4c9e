# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures the time of a frame with the rig, with the Armature modifier alone, and with a model."""
