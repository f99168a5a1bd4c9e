# SPDX-License-Identifier: GPL-3.0-or-later
"""The networks of all partitions, their training, their checkpoint, and their confidence."""
