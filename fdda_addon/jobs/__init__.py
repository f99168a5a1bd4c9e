# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs: work that takes more than a moment: how far it is, how it is cancelled, how it ended."""
