# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the arm rig: a sculpted arm with 22 joints, hard skinning, a driven biceps and Corrective Smooth."""
