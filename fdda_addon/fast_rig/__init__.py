# SPDX-License-Identifier: GPL-3.0-or-later
"""Fast rigs: copies of a character without what its model and its controls do not need."""
