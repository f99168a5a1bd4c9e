# SPDX-License-Identifier: GPL-3.0-or-later
"""Mathematics and file formats of the deformation, with numpy and the standard library only.

Both the add-on inside Blender and the trainer outside it import this package; it needs neither bpy nor torch.
"""
