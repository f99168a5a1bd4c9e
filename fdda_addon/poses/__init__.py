# SPDX-License-Identifier: GPL-3.0-or-later
"""Poses of a rig: ranges of motion, channels of random poses, and frames of actions."""
