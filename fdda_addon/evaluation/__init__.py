# SPDX-License-Identifier: GPL-3.0-or-later
"""Compares a model with its rig, and displays the errors as statistics, heat maps, graphs and pictures."""
