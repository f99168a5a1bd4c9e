# SPDX-License-Identifier: GPL-3.0-or-later
"""Compares a model with its rig, and shows how far it is off: figures, heat map, markers, pictures."""
