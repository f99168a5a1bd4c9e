# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the rig of a scene: joints, skin, controls, replaced modifiers; refuses rigs that no model can represent."""
