# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes the output of a model to files that need no model: point caches, .blend files, shape keys."""
