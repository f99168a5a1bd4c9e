# SPDX-License-Identifier: GPL-3.0-or-later
"""Plays a model in place of a rig.

`network` executes a model, `binding` ties it to a mesh object, `playback` keeps the live bindings and moves their
meshes, `handlers` calls it when Blender has evaluated a pose.
"""
