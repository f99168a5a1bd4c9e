# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of the farm: its graph on a cluster of real workers, and what render farms take."""
