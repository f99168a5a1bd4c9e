# SPDX-License-Identifier: GPL-3.0-or-later
"""Fits skin weights to recorded poses."""
