# SPDX-License-Identifier: GPL-3.0-or-later
"""The trainer: trains the networks of a recording and writes the model. Run it with `python -m trainer`.

It uses `fdda_addon.core`, torch, onnx and onnxruntime, but not Blender or bpy. docs/method.md explains the method.
"""
