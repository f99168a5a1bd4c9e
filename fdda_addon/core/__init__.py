# SPDX-License-Identifier: GPL-3.0-or-later
"""The deformation and its files: numpy and the standard library only, no bpy and no torch.

Shared by the add-on inside Blender and by the trainer outside it.
"""
