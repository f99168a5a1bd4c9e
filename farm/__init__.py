# SPDX-License-Identifier: GPL-3.0-or-later
"""Records and trains many characters on many machines: a graph of the verbs of the add-on, for several engines.

It needs neither Blender nor the add-on's Blender half in its own process: every verb runs in a process of its own.
"""
