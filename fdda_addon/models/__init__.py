# SPDX-License-Identifier: GPL-3.0-or-later
"""The model list of a mesh object, the bound model, and changes of the rig since training."""
