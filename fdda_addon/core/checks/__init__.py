# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks of a recording before training: one module for each kind of problem."""
