# SPDX-License-Identifier: GPL-3.0-or-later
"""Turns poses of a rig into a recording: planned, influences found, evaluated, and extended where it is worst."""
