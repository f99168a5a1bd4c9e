# SPDX-License-Identifier: GPL-3.0-or-later
"""Writes what a model plays to files that need no model: caches, .blend files, shape keys."""
