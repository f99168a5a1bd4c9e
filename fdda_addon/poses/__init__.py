# SPDX-License-Identifier: GPL-3.0-or-later
"""Poses of a rig: its range of motion, the channels of random poses, and the frames of actions."""
