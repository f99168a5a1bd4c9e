# SPDX-License-Identifier: GPL-3.0-or-later
"""Starts the trainer in another Python, and installs the environment of that Python."""
