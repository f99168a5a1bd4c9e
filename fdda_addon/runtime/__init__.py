# SPDX-License-Identifier: GPL-3.0-or-later
"""Plays a model in place of a rig, inside Blender's evaluation.

`network` executes a model, `binding` ties it to a mesh object. `position_buffer` creates the object that holds the
positions, `driver` its driver; `live_binding` answers it, `crowd` for several at once; `playback` keeps them, and
`handlers` is what Blender calls.
"""
