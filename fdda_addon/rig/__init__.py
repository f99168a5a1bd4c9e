# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the rig of a scene: joints, skin weights, controls and modifiers. Rejects rigs that no model can represent."""
