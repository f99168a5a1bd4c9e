# SPDX-License-Identifier: GPL-3.0-or-later
"""Trains the networks of a recording and writes the model. `python -m trainer` is the way in.

Uses `fdda_addon.core`, torch, onnx and onnxruntime; neither bpy nor Blender. docs/method.md says how the
defaults were chosen.
"""
