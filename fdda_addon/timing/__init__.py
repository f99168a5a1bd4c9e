# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures what a frame costs: the rig, its parts, and the model."""
