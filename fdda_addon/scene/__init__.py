# SPDX-License-Identifier: GPL-3.0-or-later
"""Access to the open scene: converts Blender's data to arrays and back, finds rigs, and changes state temporarily."""
