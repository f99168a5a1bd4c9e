# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python that trains: whether it can, and an environment of the add-on's own for those who have none.

`choice` says which Python trains, `check` asks it, with an `answer`; `folder` is where the environment of the add-on
lies, `bases` finds a Python to make it from, `creation` makes it; `session` keeps what was found
out, for panels to draw.
"""
