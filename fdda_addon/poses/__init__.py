# SPDX-License-Identifier: GPL-3.0-or-later
"""Which poses a rig can take: its range of motion, what random poses move, the frames of actions, the plan of poses."""
