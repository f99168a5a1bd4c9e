# SPDX-License-Identifier: GPL-3.0-or-later
"""The models of a mesh object: the list it keeps, which of them is bound, and whether they still fit the rig."""
