# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests that take whole characters through all steps."""
