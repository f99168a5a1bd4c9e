# SPDX-License-Identifier: GPL-3.0-or-later
"""Recording and training of many characters on many machines: a task graph of verbs, for several engines.

It needs neither Blender nor the add-on's Blender half in its own process: every verb runs in a process of its own.
"""
