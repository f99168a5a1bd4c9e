# SPDX-License-Identifier: GPL-3.0-or-later
"""Plays a model in place of a rig, inside Blender's evaluation.

`binding` binds a model to a mesh object, and `network` runs a model. `handlers` has the functions that Blender calls.
During an evaluation, the `driver` of a `position_buffer` calls `playback`, which finds the `player` or `player_batch`
in the `session`. The `playback_modifier` shows the positions.
"""
