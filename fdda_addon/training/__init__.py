# SPDX-License-Identifier: GPL-3.0-or-later
"""Starts the trainer in a Python of its own, and makes that Python's environment."""
